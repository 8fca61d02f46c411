"""The calibration doctor: does a recording's calibration agree with itself and with its pictures, and if not, why.

`observation` measures what does not depend on how the numbers are read; `reading` reads them under given conventions;
the `*_evidence` modules score a reading; `hypotheses` lists the usual mistakes; `doctor` decides.
Axis legend: n frames, a arms, p points on the robot, r c rows and columns of image cells.
"""
