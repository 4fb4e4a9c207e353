"""Every message of an MCAP file decoded by mcap-ros2-support. Usage: mcap_decode.py FILE."""

from __future__ import annotations

import json
import statistics
import sys
import time

from mcap_ros2.reader import read_ros2_messages


def main() -> None:
    times = []
    for _ in range(3):
        begun = time.process_time()
        count = sum(1 for _ in read_ros2_messages(sys.argv[1]))
        times.append(1e3 * (time.process_time() - begun))
    ms = statistics.median(times)
    print(json.dumps({"ms": ms, "remark": f"{count / ms:.0f} k messages/s"}))


if __name__ == "__main__":
    main()
