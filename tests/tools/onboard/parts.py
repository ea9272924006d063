"""The six parts, onboarded by the command alone: `python tests/tools/onboard/parts.py FOLDER [NAME...]`, minutes."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))

from guiderail.tools.command import main
from oracles.parts import PARTS

if __name__ == "__main__":
    out, names = Path(sys.argv[1]), sys.argv[2:] or list(PARTS)
    for name in names:
        part, drawn = PARTS[name](), out / "drawn" / name
        drawn.mkdir(parents=True, exist_ok=True)
        plug, socket = part.write(drawn)
        print(f"== {name}, drawn with {part.clearance} mm", flush=True)
        try:
            main(["onboard", str(plug), str(socket), "--unit", "mm", *part.options, "--out", str(out / name)])
        except SystemExit as end:
            if end.code:
                print(f"{name} ended with {end.code}", flush=True)
