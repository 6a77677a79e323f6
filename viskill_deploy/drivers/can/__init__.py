"""Arms whose drives hang on CAN: CiA 402 over CANopen, and simulated drives to try it with."""
