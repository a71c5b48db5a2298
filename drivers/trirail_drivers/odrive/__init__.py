"""ODrives on CANSimple."""
