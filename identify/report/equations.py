"""The fitted model as equations that an engineer can read: MathML for the page, plain text.

Both are written from the `Structure` and the fitted values, so that what is printed is what was
fitted: every base parameter appears with its number; effects follow by name with theirs.
"""

from collections.abc import Mapping, Sequence

from identify.parameters import Estimate
from identify.report.page import paragraphs, table, tag, text
from identify.report.words import listed, scientific, with_error
from identify.results import Assessment
from identify.structure import MODAL, Structure

Numbers = Mapping[str, Estimate]


def equations(a: Assessment) -> str:
    """The model as HTML: the loop in MathML, a table of modes, the effects added."""
    s = a.structure
    p = a.parameters if a.fit.converged else {}
    parts = [
        _shown(_identifier("Y"), "=", _sum_of_modes()),
        _shown(*_flame(s, p)),
        _shown(*_characteristic(s, p)),
        tag(
            "p",
            text(
                "Y: velocity (m/s), w: the flame's input (m), F: its output, U: drive (V), "
                "N acts on w in time. Positive feedback; the loop's gain sits in r."
            ),
        ),
    ]
    if p:
        head = ["mode", "frequency (Hz)", "damping ζ", "flame residue r (1/s)",
                "speaker residue a (m/s²/V)"]  # fmt: skip
        parts.append(table(head, _modes(s, p), "", (1, 2, 3, 4)))
    parts.append(paragraphs(_effects(s, p)))
    return "".join(parts)


def equations_text(a: Assessment) -> str:
    """The same in plain text."""
    s = a.structure
    p = a.parameters if a.fit.converged else {}
    lines = [
        "Y = Σ_i s (r_i s F + a_i U) / (s² + 2 ζ_i ω_i s + ω_i²),   w = H(s) Y,   F = N(w)",
        f"H(s) = {_flame_text(s, p)}",
        f"N(w) = {_characteristic_text(s, p)}",
    ]
    lines += [
        f"mode {i}: f = {f} Hz, ζ = {z}, r = {r} 1/s, a = {q} m/s²/V"
        for i, f, z, r, q in (_modes(s, p) if p else [])
    ]
    return "\n".join("  " + line for line in [*lines, *_effects(s, p)])


def _modes(s: Structure, p: Numbers) -> list[list[str]]:
    return [
        [str(i), *(with_error(p[f"mode{i}.{n}"])[0] for n in MODAL)]
        for i in range(1, s.mode_count + 1)
    ]


def _effects(s: Structure, p: Numbers) -> list[str]:
    lines = []
    for e in s.effects:
        form = f" ({e.form})" if e.form else ""
        own = {q.name: p[q.name] for q in e.parameters if q.name in p}
        lines.append(f"Added, {e.location}: {e.name}{form}, {listed(own)}")
    return lines


def poles(s: Structure) -> list[str]:
    """Names of the flame's poles."""
    return ["flame.pole_hz" if j == 1 else f"flame.pole{j}_hz" for j in range(1, s.flame_order + 1)]


def powers(s: Structure) -> list[tuple[int, str]]:
    """(power of w, parameter) of a polynomial characteristic."""
    if s.nonlinearity != "polynomial":
        return []
    return [(d, f"nonlinearity.c{d}") for d in range(2, s.degree + 1)]


def _number(name: str, p: Numbers) -> str | None:
    return scientific(p[name].value, 5) if name in p else None


# plain text ------------------------------------------------------------------------------------


def _flame_text(s: Structure, p: Numbers) -> str:
    factors = []
    for j, name in enumerate(poles(s), start=1):
        hz = _number(name, p) or f"f{j}"
        top = "1" if j == 1 else f"2π·{hz}"
        factors.append(f"{top}/(s + 2π·{hz} Hz)")
    if s.flame_delay:
        factors.append(f"exp(−s · {_number('flame.delay_s', p) or 'τ'} s)")
    return " · ".join(factors) or "1"


def _characteristic_text(s: Structure, p: Numbers) -> str:
    if s.nonlinearity == "linear":
        return "w"
    if s.nonlinearity == "saturation":
        level = _number("nonlinearity.level", p) or "L"
        return f"{level} · tanh(w / {level})"
    if s.nonlinearity == "lagrange":
        pairs = [
            f"N({scientific(x)}) = {_number(f'nonlinearity.value{j}', p) or '?'}"
            for j, x in enumerate(s.nodes, start=1)
        ]
        return "polynomial of slope one at zero through " + ", ".join(pairs)
    out = "w"
    for d, name in powers(s):
        sign, size = _signed(name, p, f"c{d}")
        out += f" {sign} {size} w{str(d).translate(RAISED)}"
    return out


RAISED = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")


def _signed(name: str, p: Numbers, symbol: str) -> tuple[str, str]:
    if name not in p:
        return "+", symbol
    value = p[name].value
    return ("−" if value < 0 else "+"), scientific(abs(value), 5)


# MathML ----------------------------------------------------------------------------------------


def _shown(*content: str) -> str:
    parts = [c if c.startswith("<") else _operator(c) for c in content]
    return tag("math", tag("mrow", *parts), display="block")


def _identifier(x: str) -> str:
    return tag("mi", text(x))


def _operator(x: str) -> str:
    return tag("mo", text(x), stretchy="false")


def _value(x: str) -> str:
    """A number; 1.2e−5 is set as a power of ten."""
    if "e" not in x:
        return tag("mn", text(x))
    mantissa, exponent = x.split("e")
    ten = tag("msup", tag("mn", "10"), tag("mn", text(exponent)))
    return tag("mrow", tag("mn", text(mantissa)), _operator("·"), ten)


def _fraction(top: str, bottom: str) -> str:
    return tag("mfrac", tag("mrow", top), tag("mrow", bottom))


def _sub(x: str, i: str) -> str:
    return tag("msub", _identifier(x), _identifier(i))


def _power(x: str, n: object) -> str:
    return tag("msup", x, tag("mn", text(n)))


def _sum_of_modes() -> str:
    s = _identifier("s")
    inside = (
        _sub("r", "i") + s + _identifier("F") + _operator("+") + _sub("a", "i") + _identifier("U")
    )
    top = s + _operator("(") + inside + _operator(")")
    bottom = (
        _power(s, 2)
        + _operator("+")
        + tag("mn", "2")
        + _sub("ζ", "i")
        + _sub("ω", "i")
        + s
        + _operator("+")
        + tag("msubsup", _identifier("ω"), _identifier("i"), tag("mn", "2"))
    )
    total = tag("munder", tag("mo", "∑", largeop="true", movablelimits="false"), _identifier("i"))
    return tag("mrow", total, _fraction(top, bottom))


def _flame(s: Structure, p: Numbers) -> Sequence[str]:
    factors: list[str] = []
    for j, name in enumerate(poles(s), start=1):
        known = _number(name, p)
        pole = (
            tag("mn", "2") + _identifier("π") + _operator("·") + _value(known) + _unit("Hz")
            if known
            else _sub("ω", f"f{j}")
        )
        top = tag("mn", "1") if j == 1 else pole
        factors.append(_fraction(top, _identifier("s") + _operator("+") + pole))
    if s.flame_delay:
        known = _number("flame.delay_s", p)
        tau = _value(known) + _unit("s") if known else _identifier("τ")
        exponent = tag("mrow", _operator("−"), _identifier("s"), _operator("·"), tau)
        factors.append(tag("msup", _identifier("e"), exponent))
    right = "".join(factors) or tag("mn", "1")
    return (
        _identifier("w"), "=", _identifier("H"), "(", _identifier("s"), ")", _identifier("Y"),
        ",", tag("mspace", width="1.5em"), _identifier("H"), "(", _identifier("s"), ")", "=",
        tag("mrow", right),
    )  # fmt: skip


def _unit(x: str) -> str:
    return tag("mspace", width="0.15em") + tag("mtext", text(x))


def _characteristic(s: Structure, p: Numbers) -> Sequence[str]:
    w = _identifier("w")
    left = (_identifier("F"), "=", _identifier("N"), "(", w, ")", "=")
    if s.nonlinearity == "polynomial":
        terms = [w]
        for d, name in powers(s):
            sign, size = _signed(name, p, f"c{d}")
            terms += [sign, _value(size) if name in p else _identifier(size), _power(w, d)]
        return (*left, *terms)
    if s.nonlinearity == "saturation":
        known = _number("nonlinearity.level", p)
        level = _value(known) if known else _identifier("L")
        inner = _fraction(w, level)
        return (*left, level, tag("mo", "tanh"), "(", inner, ")")
    return (*left, tag("mtext", text(_characteristic_text(s, p))))
