"""What came of the inputs that were tried, for the report at the end of a long run."""

from collections import Counter

TRIED: Counter[tuple[str, str]] = Counter()


def attempt(target: str, refusal: type[Exception], call):
    """What `call` returns, or None where it refuses; anything else that it raises is a failure."""
    try:
        result = call()
    except refusal as error:
        said = str(error)
    else:
        TRIED[target, "accepted"] += 1
        return result
    TRIED[target, "refused"] += 1
    # One sentence: it is printed as it is.
    assert "\n" not in said
    assert 0 < len(said) < 1000
    return None
