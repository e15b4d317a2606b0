"""Launch monitors over GSPro's Open Connect: receive their shots, forward shots to a simulator.

Launch monitors connect to `server`, `simulator_link` forwards shots, `record` assigns launches to swings.
`open_connect` implements the protocol, `conversation` one connection's state.
"""
