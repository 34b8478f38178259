"""`python -m benchmarks.mcap_recovery`: messages read from damaged MCAP files, here and by MCAP's own tool.

Each of four small logs (zstd, lz4, no compression, no chunks; checksums on) is damaged in five ways at many places.
The ways are: cut; one byte changed; 64 bytes of zeros; 64 bytes removed; eight bytes replaced by a large number. A
message is right if the undamaged log contains it (topic, time and bytes). The tool is `mcap recover`, as
`benchmarks.mcap_recover` implements it.
"""

import argparse
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

from mcap.writer import CompressionType, Writer

from benchmarks.mcap_recover import Key, recover
from splatctrl_cli.cli.common import table
from splatctrl_cli.recording.container.mcap_log import McapLog
from splatctrl_cli.recording.container.raw_log import Damage

NUM_MESSAGES, SIZE, CHUNK = 48, 120, 1200
DAMAGES: dict[str, Callable[[bytes, int], bytes]] = {
    "cut": lambda data, at: data[:at],
    "one byte changed": lambda data, at: data[:at] + bytes([data[at] ^ 0x55]) + data[at + 1 :],
    "64 bytes of zeros": lambda data, at: data[:at] + bytes(64) + data[at + 64 :],
    "64 bytes missing": lambda data, at: data[:at] + data[at + 64 :],
    "a large number": lambda data, at: data[:at] + (1 << 62).to_bytes(8, "little") + data[at + 8 :],
}
LOGS: dict[str, tuple[CompressionType, bool]] = {
    "zstd": (CompressionType.ZSTD, True),
    "lz4": (CompressionType.LZ4, True),
    "not compressed": (CompressionType.NONE, True),
    "no chunks": (CompressionType.NONE, False),
}


@dataclass(frozen=True, kw_only=True)
class Counted:
    """Numbers of right messages of one damaged file. read: here; copied, decoded: by the tool, copying and decoding;
    lacking: kept by the tool but not read here. claimed: reported by the tool when copying.
    """

    read: int
    copied: int
    decoded: int
    lacking: int
    claimed: int
    is_told: bool


def log(compression: CompressionType, is_chunked: bool) -> bytes:
    """A log of two topics, whose messages compress a little."""
    stream = BytesIO()
    writer = Writer(stream, chunk_size=CHUNK, compression=compression, use_chunking=is_chunked, enable_data_crcs=True)
    writer.start(profile="", library="benchmarks")
    schema = writer.register_schema(name="x", encoding="", data=b"")
    topics = [writer.register_channel(topic=name, message_encoding="x", schema_id=schema) for name in ("/a", "/b")]
    for i in range(NUM_MESSAGES):
        data = b"".join(((i * 7919 + k * k * 31) % 251).to_bytes(1, "little") for k in range(SIZE - 40)) + bytes(40)
        writer.add_message(topics[i % 2], log_time=i + 1, publish_time=i + 1, data=data)
    writer.finish()
    return stream.getvalue()


def damaged(data: bytes, kind: str, step: int) -> Iterator[bytes]:
    """The file damaged in one way, at every `step`-th byte."""
    for at in range(8, len(data) - 64, step):
        yield DAMAGES[kind](data, at)


def counted(data: bytes, truth: Counter[Key], path: Path) -> Counted:
    """Counts for one damaged file, which is written to `path`."""
    path.write_bytes(data)
    damage = Damage()
    mine = Counter((m.topic.name, m.log_time_ns, m.data) for m in McapLog(path).messages(damage)) & truth
    copied, decoded = recover(data), recover(data, always_decode=True)
    theirs = [Counter(found.kept) & truth for found in (copied, decoded)]
    return Counted(
        read=mine.total(),
        copied=theirs[0].total(),
        decoded=theirs[1].total(),
        lacking=max((each - mine).total() for each in theirs),
        claimed=copied.claimed,
        is_told=damage.count > 0,
    )


def run(argv: Sequence[str] | None = None) -> int:
    """Print a table; return 1 if the tool recovers a message that is not read here."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.mcap_recovery", description=__doc__)
    parser.add_argument("--step", type=int, default=5, help="bytes between places")
    args = parser.parse_args(argv)
    rows, lacking = [], 0
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "x.mcap"
        for log_name, (compression, is_chunked) in LOGS.items():
            data = log(compression, is_chunked)
            truth = Counter(recover(data).kept)
            for kind in DAMAGES:
                found = [counted(each, truth, path) for each in damaged(data, kind, args.step)]
                total = len(found) * truth.total()
                sums = [sum(getattr(c, key) for c in found) for key in ("read", "decoded", "copied", "claimed")]
                shares = [f"{100 * value / total:.1f}" for value in sums]
                behind = sum(c.lacking for c in found)
                silent = sum(c.read < truth.total() and not c.is_told for c in found)
                rows.append([log_name, kind, len(found), *shares, behind, silent])
                lacking += behind
    header = ["log", "damage", "files", "read %", "-a %", "recover %", "it claims %", "read less", "lost unsaid"]
    print("\n".join(table(header, rows)))
    return 1 if lacking else 0


if __name__ == "__main__":
    sys.exit(run())
