"""What carries frames: buses, what is heard and sent on them, what goes wrong with them."""
