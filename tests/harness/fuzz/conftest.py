"""Summary of the fuzzed inputs of a long run."""

from fuzz.tally import COUNTS


def pytest_terminal_summary(terminalreporter, config):
    if config.getoption("--hypothesis-profile") != "long":
        return
    for target in sorted({target for target, _ in COUNTS}):
        accepted, refused = COUNTS[target, "accepted"], COUNTS[target, "refused"]
        terminalreporter.write_line(f"{target}: {accepted + refused} inputs, {accepted} accepted, {refused} refused")
    terminalreporter.write_line(f"together: {sum(COUNTS.values())} inputs")
