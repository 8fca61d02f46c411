"""Cameras that nobody measured, estimated from recorded episodes alone."""
