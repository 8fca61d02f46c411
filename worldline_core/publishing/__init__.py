"""Pushing and pulling finished sets: the Hugging Face hub, folders, object stores."""
