"""The calibration doctor: does a recording's calibration agree with itself and with its pictures, and if not, why?

Bottom to top: `observation` measures an episode and reads it under given conventions; `evidence` scores a reading;
`camera_errors` estimates the error of each camera; `diagnosis` decides, for an episode and for the sum over a source;
`calibration_doctor` searches the usual mistakes; `check` does this for all episodes of a source and shows it (`worldline
calibrate check`).
"""
