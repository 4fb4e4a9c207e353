"""The arm whose joints are received: read off the description as soon as it and the joints' names are known."""

from __future__ import annotations

from typing import Any

import numpy as np

from modcal_core.calibration import fingerprint
from modcal_core.errors import BadRecording, ModcalError
from modcal_core.measurements import joint_limits
from modcal_core.measurements.kinds import kinds
from modcal_core.online import SampleStream
from modcal_core.robots import Chain, Delta, Mechanism, is_serial_arm, read_chain
from modcal_msgs_py import JOINT_COMMANDS, READING, Commands, seconds


class KnownArm:
    """description: URDF text, empty while unknown. chain, stream: None until the arm is known. trouble: why not."""

    def __init__(self, description: str, base: str, tip: str, delta: Delta | None = None) -> None:
        """description: given by a parameter, so that none is taken from the topic; empty: to be heard. delta: a robot
        that needs no description.
        """
        self.description = description
        self.delta = delta
        self.chain: Mechanism | None = None
        self.stream: SampleStream | None = None
        self.trouble = ""
        self._given, self._base, self._tip = bool(description), base, tip
        self._tried: tuple[str, frozenset[str]] | None = None
        self._largest, self._reach = np.empty(0), 0.0
        self._order: dict[tuple[str, ...], np.ndarray | None] = {}

    @property
    def serial(self) -> Chain | None:
        """The arm, where it is known and a serial chain."""
        return self.chain if self.chain is not None and is_serial_arm(self.chain) else None

    def describe(self, text: str) -> None:
        """Take a description that was published. Another one, later, is refused: that is another robot."""
        if self._given or self.delta is not None or text == self.description:
            return
        if self.chain is None:
            self.description = text
        elif not self._is_the_same(text):
            self.trouble = "robot_description has changed while running: restart this node to calibrate another robot"

    def _is_the_same(self, text: str) -> bool:
        assert self.chain is not None
        try:
            return fingerprint(read_chain(text, self.chain.base, self.chain.tip)) == fingerprint(self.chain)
        except ModcalError:
            return False

    def recognise(self, names: frozenset[str]) -> bool:
        """Read the arm, given the names of all joints heard so far; returns whether it has become known just now."""
        known = bool(self.description) or self.delta is not None
        if self.chain is not None or not known or not names or self._tried == (self.description, names):
            return False
        self._tried = self.description, names  # reading a description takes as long as a hundred messages
        chain: Mechanism
        try:
            chain = self.delta or read_chain(self.description, self._base or None, self._tip or None, names)
        except ModcalError as error:
            self.trouble = str(error)
            return False
        if not set(chain.names) <= names:
            self.trouble = f"joint_states does not name {', '.join(n for n in chain.names if n not in names)} yet"
            return False
        self.chain, self.trouble = chain, ""
        self.stream = SampleStream(chain.names)
        self._largest, self._reach = joint_limits(chain), chain.reach()
        return True

    def joint_state(self, message: Any) -> None:
        """Hand a joint state to the stream, if it names the whole arm, in any order and among others."""
        names = tuple(message.name)
        if self.stream is None or self.chain is None:
            return
        if names not in self._order:
            whole = set(self.chain.names) <= set(names)
            self._order[names] = np.array([names.index(n) for n in self.chain.names]) if whole else None
        order = self._order[names]
        if order is not None:
            effort = np.frombuffer(message.effort)[order] if len(message.effort) == len(names) else None
            position = np.frombuffer(message.position)[order]
            if (np.abs(position) > self._largest).any():
                worst = int(np.argmax(np.abs(position) / self._largest))
                said = f"position {position[worst]:.4g}, {self._largest[worst]:.4g} is the limit"
                raise BadRecording(f"joint {self.chain.names[worst]}", said, "publish radians and metres")
            self.stream.joint_state(seconds(message.header.stamp), position, effort)

    def command(self, type_name: str, message: Any, received: float) -> None:
        """Add a message of commands to the stream; joints that it does not name keep their last command."""
        if self.stream is None or self.chain is None:
            return
        told = Commands()
        told.add(JOINT_COMMANDS, type_name, message, seconds(message.header.stamp) or received, received)
        for track in told.tracks(lambda _: 0):
            if len(track.stamps):
                unnamed = np.full(len(track.stamps), np.nan)
                columns = [
                    track.position[:, track.names.index(name)] if name in track.names else unnamed
                    for name in self.chain.names
                ]
                self.stream.command(track.stamps, np.stack(columns, axis=1))

    def position(self, message: Any) -> np.ndarray | None:
        """The arm's joints in a joint state, (n,); None where it does not name the whole arm."""
        order = self._order.get(tuple(message.name))
        return None if order is None else np.frombuffer(message.position)[order].copy()

    def reading(self, kind: str, message: Any) -> None:
        """Hand a reading to the stream."""
        if self.stream is not None:
            values = np.array(READING[kind](message))
            if np.isfinite(values).all() and kinds()[kind].implausible(values[None], self._reach).any():
                said = f"reads {', '.join(f'{x:.4g}' for x in values)}"
                raise BadRecording(f"{kind} in {message.header.frame_id}", said, "publish metres and unit quaternions")
            self.stream.reading(kind, message.header.frame_id, seconds(message.header.stamp), values)
