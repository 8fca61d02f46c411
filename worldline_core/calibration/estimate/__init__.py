"""Cameras estimated from recorded episodes alone."""
