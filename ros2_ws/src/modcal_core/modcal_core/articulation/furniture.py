"""What is known of furniture before any of it is seen. Physical sizes, from what people build, not from any recording.

* Hinges lie about a forearm from the handle, from a knob's 3 cm to a garage door's 2 m: 95 % within 0.10 to 1.6 m.
* A screw rises by millimetres (a jar) to decimetres (a spiral slide) in a radian: 95 % within 2 to 200 mm/rad.
* Nothing moves ideally: handles have play, hands settle, trackers are biased, oven doors bend. What is seen departs
  from the ideal path by an amount of unknown size, about 2 mm and 1.4°, that is alike within a hand's width of path.
* What measures is distorted as well, an arm that is not calibrated or a camera: by about 2 mm and 0.6°, alike over some
  30 cm.
* Where a grasp is a ball, or slips, rotations say nothing of the object: one in ten. Then they are off by half a
  radian, or the hand keeps its orientation, one as often as the other.
* One in twenty is no furniture but a stage, a rail or a bearing before an instrument for such: play and distortion are
  a tenth or a hundredth of the usual, and its axis is anywhere between 1 mm and a forearm away.
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
