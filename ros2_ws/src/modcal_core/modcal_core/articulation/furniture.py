"""What is known of furniture before any of it is seen. Physical sizes, from what people build, not from any recording.

* Hinges lie about a forearm from the handle: a knob has 3 cm, a cupboard door 30 to 60 cm, a room door 80 cm, a garage
  door 2 m. log r is normal about log 0.4 m with 0.7, so 95 % lie between 0.10 and 1.6 m.
* A screw that a person would call one rises by millimetres to decimetres in a radian: a jar 1 to 2, a rising hinge 5
  to 10, a spiral slide 100 and more. log |pitch| is normal about log 20 mm/rad with 1.2, so 95 % lie between 2 and 200.
* Nothing moves ideally. A handle has play, a hand settles in it, a tracker's bias changes with place, an oven door
  bends. So what is seen departs from the ideal path by an amount that is alike in neighbouring places. Its size is not
  known: log-normal about 2 mm with a factor of 2.2 for positions, and about 1.4° with a factor of 2.5 for rotations;
  how far "neighbouring" reaches is a hand's width, 10 cm of path.
* What measures is itself distorted: an arm that is not calibrated, or a camera that sees a marker, errs by about 2
  mm and 0.6°, within a factor of 2.2, alike over some 30 cm. How smooth a departure is says nothing of how large a
  smooth one may be.
* Where a grasp is a ball, or slips, rotations say nothing of the object: one in ten, and then they are off by half a
  radian, or the hand keeps its orientation, one as often as the other.
* One in twenty is no furniture but a stage, a rail or a bearing before an instrument for such: its play, and what
  distorts the readings, are a tenth or a hundredth of the usual, and its axis is anywhere between 1 mm and a forearm
  away. What measures it scatters by no more than that share of a usual millimetre, within a factor of 2.2. Without
  these a bow of millimetres that is seen to micrometres would be play, and so would a turn about an axis 5 mm away.
"""

from __future__ import annotations

from math import log

RADIUS = (log(0.4), 0.7)  # of hinges [m]; mean and deviation of the logarithm, as all that follow
PITCH = (log(0.02), 1.2)  # of screws [m/rad]
PLAY = (log(2e-3), log(2.2))  # of positions [m]
SWAY = (log(0.025), log(2.5))  # of rotations [rad]
LOOSE = (log(0.5), log(2.0), 0.05)  # rotations of a grasp that turns [rad], and how often that is so
HELD = 0.05  # how often the hand keeps its orientation in a grasp that turns
REACH = 0.1  # m of path over which a departure stays alike
DISTORTION = (2e-3, 0.01)  # m, rad
DISTORTED = log(2.2)  # how far both may be off together
DISTORTION_REACH = 0.3  # m
SPAN = 1.0  # m over which a handle may move: as far as any, before it is seen
FINE = (0.01, 0.1), 0.05  # times the usual sizes, and how often it is one of them
NOISE = 1e-3  # m, of a usual sample
NEAREST = log(1e-3)  # m, of a fine one's axis; logarithms alike up to a forearm
