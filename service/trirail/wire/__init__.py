"""What goes between processes and over Zenoh: messages, packets, records, and the connections that carry them."""
