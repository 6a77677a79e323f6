"""Arms that speak CRTK, as dVRK's do: driver, simulated server, and the ways between them."""
