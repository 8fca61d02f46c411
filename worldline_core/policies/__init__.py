"""Policies that run elsewhere: arrays in msgpack messages, and openpi's websocket protocol."""
