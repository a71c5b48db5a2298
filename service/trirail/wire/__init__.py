"""Messages over Zenoh, packets and records between the service's processes, and the connections that transport them."""
