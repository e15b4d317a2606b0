"""The bench's hardware on CANopen: three encoders after CiA 406, valves and interlocks after CiA 401."""
