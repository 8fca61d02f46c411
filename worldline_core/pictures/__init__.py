"""Labelled pictures: contact sheets, strips and side-by-side videos."""
