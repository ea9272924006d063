"""Runs programs one after the other in one process, as importing costs more than most of them: file to what it printed.

Prints one JSON object: by file, its standard output, and the traceback that ended it where one did.
"""

import contextlib
import io
import json
import runpy
import sys
import traceback


def main() -> None:
    files, found = sys.argv[1:], {}
    for file in files:
        sys.argv = [file]
        printed, wrong = io.StringIO(), ""
        with contextlib.redirect_stdout(printed):
            try:
                runpy.run_path(file, run_name="__main__")
            except Exception:
                wrong = traceback.format_exc()
        found[file] = {"printed": printed.getvalue(), "wrong": wrong}
    print(json.dumps(found))


if __name__ == "__main__":  # an example may begin processes, which import this file
    main()
