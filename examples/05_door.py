"""How does it open? The joint of a door from a track of its handle: what kind, about which axis, how sure."""

import numpy as np

import modcal

rng = np.random.default_rng(4)
HINGE, RADIUS = np.array([0.6, 1.2, 0.0]), 0.72  # m

angle = np.linspace(0.0, np.radians(40.0), 80)
handle = HINGE + np.stack([-RADIUS * np.cos(angle), -RADIUS * np.sin(angle), np.full(80, 1.05)], axis=1)
handle += 1e-3 * rng.normal(size=handle.shape)

choice = modcal.articulate(modcal.Track.from_arrays(points=handle))
model = choice.fit.model
print(choice.why)
print({kind: round(float(p), 4) for kind, p in choice.probabilities.items()})
print(f"axis {np.round(model.axis, 3)}, radius {model.radius:.3f} m, enough seen: {choice.enough}")
