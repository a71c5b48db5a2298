"""ODrive drives on CANSimple."""
