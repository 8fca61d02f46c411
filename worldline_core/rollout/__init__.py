"""Predicting videos: Euler integration of the flow, whole clips or block by block, and sets of predicted videos."""
