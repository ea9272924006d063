"""Run programs one after the other in one process, because importing takes longer than most of them.

Prints one JSON object from file to its standard output and its traceback, if it failed.
"""

import contextlib
import io
import json
import runpy
import sys
import traceback


def main() -> None:
    files, result = sys.argv[1:], {}
    for file in files:
        sys.argv = [file]
        printed, wrong = io.StringIO(), ""
        with contextlib.redirect_stdout(printed):
            try:
                runpy.run_path(file, run_name="__main__")
            except Exception:
                wrong = traceback.format_exc()
        result[file] = {"printed": printed.getvalue(), "wrong": wrong}
    print(json.dumps(result))


if __name__ == "__main__":  # processes that an example starts import this file
    main()
