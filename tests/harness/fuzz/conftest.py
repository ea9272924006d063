"""Summary of the fuzzed inputs of a long run."""

from fuzz.tally import COUNTS


def pytest_terminal_summary(terminalreporter, config):
    """Print the outcomes of the inputs of each target."""
    if config.getoption("--hypothesis-profile") != "long":
        return
    for target in sorted({target for target, _ in COUNTS}):
        accepted, refused = COUNTS[target, "accepted"], COUNTS[target, "refused"]
        terminalreporter.write_line(f"{target}: {accepted + refused} inputs, {accepted} accepted, {refused} refused")
    total = sum(count for (_, outcome), count in COUNTS.items() if outcome == "inputs")
    terminalreporter.write_line(f"total: {total} inputs")
