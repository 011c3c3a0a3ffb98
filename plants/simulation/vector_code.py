"""CasADi's C functions rewritten for vectors: one lane for each of several rows of parameters.

CasADi writes one statement for each operation, on scalars. The same statements on GCC's vector
types work out as many rows at once as a register holds, with the same rounding.
"""

import re
from functools import cache
from pathlib import Path

LANES = 8
"""Rows side by side: as many as the widest registers hold."""
IN_VECTORS = ("sq", "fabs", "fmin", "fmax", "sign", "if_else")
"""Functions that are written for vectors in `vectors.h`; others are worked out lane by lane."""

_FUNCTION = r"/\* estune_{name}:.*?\*/\nstatic int casadi_f\d+\(.*?\{{\n(.*?)\n  return 0;\n\}}"
_REWRITTEN = (
    (r"arg\[(\d+)\]\? arg\[\1\]\[(\d+)\] : 0", r"arg[\1][\2]"),
    (r"if \(res\[(\d+)\]!=0\) ", ""),
    (r"casadi_real ", "Vector "),
    (r"=([-+0-9.eE]+);", r"=ALL(\1);"),
    (r"\((a\d+)\?(a\d+):0\)", r"casadi_if_else(\1,\2)"),
    (r"\((a\d+)(<=|<|==|!=)(a\d+)\)", r"TRUTH(\1\2\3)"),
    (r"\((a\d+)&&(a\d+)\)", r"TRUTH((\1!=0.)&(\2!=0.))"),
    (r"\((a\d+)\|\|(a\d+)\)", r"TRUTH((\1!=0.)|(\2!=0.))"),
    (r"\(!(a\d+)\)", r"TRUTH(\1==0.)"),
    (r"=(?:casadi_)?([a-z]\w*)\((?=a\d+[,)])", r"=lanes_\1("),
)


def vector_code(source: str, names: tuple[str, ...]) -> str:
    """Functions of a C source once more, for vectors: `rows_name` for each `estune_name`.

    Args:
        source: C source that CasADi generated.
        names: Their names without the prefix.
    """
    bodies = {}
    for name in names:
        found = re.search(_FUNCTION.format(name=name), source, re.DOTALL)
        assert found is not None  # noqa: S101  CasADi writes each function it was given
        body = found[1]
        for pattern, replacement in _REWRITTEN:
            body = re.sub(pattern, replacement, body)
        bodies[name] = body
    used = sorted(set(re.findall(r"=lanes_(\w+)\(a\d+(,?)", "\n".join(bodies.values()))))
    return "\n".join(
        [
            f"#define LANES {LANES}",
            Path(__file__).with_name("vectors.h").read_text(encoding="utf-8"),
            *(
                f"LANE_BY_LANE_{2 if comma else 1}({name})"
                for name, comma in used
                if name not in IN_VECTORS
            ),
            *(
                f"WITHIN void rows_{name}(const Vector **arg, Vector **res) {{\n{body}\n}}"
                for name, body in bodies.items()
            ),
        ]
    )


@cache
def vector_target() -> str:
    """Pragma that lets GCC use the widest registers of this processor; empty where not known."""
    try:
        told = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    except OSError:
        return ""
    flags = set(re.findall(r"^flags\s*: (.*)$", told, re.MULTILINE)[:1][0].split())
    wide = {"avx512f", "avx512dq", "avx512vl"}
    if wide <= flags:
        return f'#pragma GCC target("{",".join(sorted(wide))},prefer-vector-width=512")'
    return '#pragma GCC target("avx2")' if "avx2" in flags else ""
