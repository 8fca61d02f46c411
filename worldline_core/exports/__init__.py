"""Exports: labelled pictures, browser videos, Rerun recordings and MCAP files.

Axes: frames are `n h w 3` uint8 RGB; views follow the project's fixed order (head, left wrist, right wrist).
Import from the submodules: `contact_sheet`, `side_by_side`, `overlays`, `overlay_views`,
`rerun_recording`, `rerun_blueprint`, `mcap_recording`, `rollout`.
"""
