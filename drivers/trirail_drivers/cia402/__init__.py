"""CiA 402 drives on CANopen."""
