"""Run programs one after the other in one process, because imports take longer than most programs.

Prints a JSON object that maps each file to its standard output and its traceback; the traceback is empty on success.
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
        output, failure = io.StringIO(), ""
        with contextlib.redirect_stdout(output):
            try:
                runpy.run_path(file, run_name="__main__")
            except Exception:
                failure = traceback.format_exc()
        result[file] = {"output": output.getvalue(), "failure": failure}
    print(json.dumps(result))


if __name__ == "__main__":  # child processes of an example import this file
    main()
