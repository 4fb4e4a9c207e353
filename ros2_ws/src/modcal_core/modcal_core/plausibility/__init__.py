"""Whether a recording and a description can belong together: conventions, units, joints, single channels."""
