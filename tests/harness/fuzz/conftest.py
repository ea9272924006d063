"""Says how many inputs a long run tried, and what came of them."""

from fuzz.tally import TRIED


def pytest_terminal_summary(terminalreporter, config):
    if config.getoption("--hypothesis-profile") != "long":
        return
    for target in sorted({target for target, _ in TRIED}):
        accepted, refused = TRIED[target, "accepted"], TRIED[target, "refused"]
        terminalreporter.write_line(f"{target}: {accepted + refused} inputs, {accepted} accepted, {refused} refused")
    terminalreporter.write_line(f"together: {sum(TRIED.values())} inputs")
