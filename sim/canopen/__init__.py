"""CANopen slaves written for simulation: dictionary, SDO server, PDOs, CiA 402 drive, CiA 406 encoder."""
