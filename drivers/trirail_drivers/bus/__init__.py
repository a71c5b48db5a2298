"""CAN frames and buses, and their errors."""
