"""Messages, packets and records between processes and over Zenoh, and the connections that carry them."""
