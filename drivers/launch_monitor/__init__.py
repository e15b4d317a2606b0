"""Launch monitors over GSPro's Open Connect: they tell us their shots, we tell a simulator ours.

`server` is what a launch monitor connects to, `client` passes shots on; `matching` brings swings and
launches together. `open_connect` holds the protocol, `objects` finds its messages in a stream of bytes.
"""
