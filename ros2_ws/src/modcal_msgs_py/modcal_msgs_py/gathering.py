"""Small blocks of messages put together: a block costs as much to look at as some hundred messages do.

Recorders that write several times a second, so that little is lost when they are killed, leave a block each time.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from modcal_msgs_py.mcap_walk import Block

_MIN = 1 << 18  # bytes; beyond, a block's own cost is a hundredth of its messages'


def gathered(blocks: Iterable[Block]) -> Iterator[Block]:
    """The same messages in the same order, in blocks of some size.

    A block with messages of a channel that was not met before stays as it is, so that topics are met in the same order.
    """
    met: set[int] = set()
    held: list[Block] = []
    size = 0
    for block in blocks:
        channels = set(np.flatnonzero(np.bincount(block.heads["channel"])).tolist())
        new = not channels <= met
        met |= channels
        if new or size >= _MIN:
            yield from _joined(held)
            held, size = [], 0
        if new:
            yield block
        else:
            held.append(block)
            size += len(block.content)
    yield from _joined(held)


def _joined(blocks: list[Block]) -> Iterator[Block]:
    """One block of all, the padding of the last one at its end; none of none."""
    if len(blocks) < 2:
        yield from blocks
        return
    shifts = np.cumsum([0, *(len(block.content) for block in blocks[:-1])])
    yield Block(
        b"".join(block.content for block in blocks),
        np.concatenate([block.heads for block in blocks]),
        np.concatenate([block.starts + shift for block, shift in zip(blocks, shifts, strict=True)]),
        np.concatenate([block.stops + shift for block, shift in zip(blocks, shifts, strict=True)]),
    )
