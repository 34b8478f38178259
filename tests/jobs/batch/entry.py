"""A program for nodes of tests: words that say what to do, one after the other."""

import json
import os
import signal
import sys
import time
from pathlib import Path


def main(words: list[str]) -> int:
    """Do what the words say, and return the exit code."""
    code, words = 0, list(words)
    while words:
        match words.pop(0):
            case "write":  # FOLDER TEXT
                folder, text = Path(words.pop(0)), words.pop(0)
                folder.mkdir(parents=True, exist_ok=True)
                (folder / "run.json").write_text(text)
            case "tell":  # FILE: one line for each run that got so far
                with Path(words.pop(0)).open("a") as stream:
                    stream.write(f"{os.getpid()}\n")
            case "words":  # FILE: what comes after it
                Path(words.pop(0)).write_text(" ".join(words))
            case "card":  # FILE: the card that is seen; what else is a word to it
                Path(words.pop(0)).write_text(os.environ.get("CUDA_VISIBLE_DEVICES", "any"))
            case "cuda:1" | "cuda":
                pass
            case "sleep":
                time.sleep(float(words.pop(0)))
            case "allocate":  # MB
                kept = bytearray(int(words.pop(0)) << 20)
                kept[::4096] = b"x" * len(kept[::4096])
                time.sleep(1.0)
            case "verdict":  # OUTCOME LABEL
                sys.stdout.write(
                    json.dumps(
                        {"verdict": {"outcome": words.pop(0), "label": words.pop(0), "sentence": "a sentence"}}
                    )
                )
            case "say":
                sys.stderr.write(words.pop(0) + "\n")
            case "die":
                os.kill(os.getpid(), getattr(signal, words.pop(0)))
            case "kill-parent":
                os.kill(os.getppid(), signal.SIGKILL)
                time.sleep(10)
            case "once":  # FILE: dies the first time
                if not Path(words[0]).exists():
                    Path(words[0]).touch()
                    os.kill(os.getpid(), signal.SIGKILL)
                words.pop(0)
            case "exit":
                code = int(words.pop(0))
    return code
