"""A reader of recordings with nothing but mcap and msgpack: position error of the belief against the truth."""

import math
import sys

import msgpack
from mcap.reader import make_reader

truth, beliefs = {}, []
with open(sys.argv[1], "rb") as file:
    for _, channel, message in make_reader(file).iter_messages():
        fields = msgpack.unpackb(message.data)
        name = channel.metadata["topic"]
        if name == "scan":
            ranges = memoryview(fields["ranges"]).cast("f")  # little-endian float32, m; inf: no return, 0: none
        elif name == "truth":
            truth[fields["stamp_ns"]] = fields["pose"]
        elif name == "belief":
            beliefs.append(fields)
# Only now, because a belief may be recorded before the truth of the same stamp.
pairs = [(belief["pose"], truth[belief["stamp_ns"]]) for belief in beliefs if belief["stamp_ns"] in truth]
errors = [math.hypot(here["x"] - there["x"], here["y"] - there["y"]) for here, there in pairs]
print(f"{len(errors)} beliefs, {len(ranges)} beams, median error {sorted(errors)[len(errors) // 2]:.4f} m")
