"""Numbers and lists in the words of a report."""

from collections.abc import Collection, Iterable


def quantity(value: float, error: float | None = None) -> str:
    """Write a number with as many digits as its error allows, or three: "−0.0118 ± 0.0004", "(1.23 ± 0.05)×10⁵"."""
    if value != value or (error is not None and error != error):
        return "undefined"
    magnitude = max(abs(value), error or 0.0)
    exponent = int(f"{magnitude:e}".partition("e")[2]) if magnitude else 0
    power = exponent if exponent >= 4 or exponent < -3 else 0
    scale = 10.0**power
    if not error:
        text = f"{value / scale:.{max(0, 2 - exponent + power)}f}"
    else:
        decimals = max(0, 1 - int(f"{error / scale:e}".partition("e")[2]))
        text = f"{value / scale:.{decimals}f} ± {error / scale:.{decimals}f}"
    text = text.replace("-", "−")
    if not power:
        return text
    return f"({text})×10{superscript(power)}" if error else f"{text}×10{superscript(power)}"


def superscript(number: int) -> str:
    """Write an integer as an exponent."""
    return str(number).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))


def percent(share: float) -> str:
    """Write a share with two digits, such as "3.2%" or "120%"."""
    return f"{100 * share:.2g}%" if share < 0.995 else f"{100 * share:.0f}%"


def joined(parts: Iterable[str], last: str = "and") -> str:
    """Write a list, such as "a, b and c"."""
    *first, end = parts
    return f"{', '.join(first)} {last} {end}" if first else end


def named(labels: Collection[str], among: int, *, words: int) -> str:
    """List the labels, or count them where that takes more words than there is room for: "a and b", "5 of 8", "all 8"."""
    listed = joined(labels) if labels else "none"
    if len(listed.split()) <= words:
        return listed
    return f"all {among}" if len(labels) == among else f"{len(labels)} of {among}"


def counted(number: int, one: str, several: str) -> str:
    """Count things, such as "one seed" and "3 seeds"."""
    return f"one {one}" if number == 1 else f"{number} {several}"


def merged(sentences: Iterable[str]) -> list[str]:
    """Say once what is said of several: "a: it is so" and "b: it is so" become "a and b: it is so"."""
    subjects: dict[str, list[str]] = {}
    for sentence in sentences:
        subject, colon, text = sentence.partition(": ")
        subjects.setdefault(text if colon else sentence, []).append(subject if colon else "")
    return [f"{joined(dict.fromkeys(told))}: {text}" if told[0] else text for text, told in subjects.items()]


def capitalised(text: str) -> str:
    """Begin with a capital, and leave the rest as it is; α stays what it is, for its capital reads as a Latin A."""
    return text[:1].upper() + text[1:] if text[:1].isascii() else text
