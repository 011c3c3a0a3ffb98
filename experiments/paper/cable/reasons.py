"""Explanation why no cable fits three quantities: the violated bound."""

import numpy as np


def explain_contradiction(w: float, given: dict[str, float]) -> str:
    """The bound violated by these values, in one sentence.

    Args:
        w: Weight per length, N/m.
        given: The three quantities by name.
    """
    for check in (_components, _lengths, _weight_bound, _span_bound):
        message = check(w, given)
        if message:
            return message
    values = ", ".join(f"{name} {value:.6g}" for name, value in given.items())
    return f"{values} with {w:.6g} N/m contradict each other; check them, or give another triple"


def _components(w: float, given: dict[str, float]) -> str:
    """Bounds between a tension and its components, and between both tensions and the rise."""
    for end in ("1", "3"):
        total, vertical = given.get(f"tension_{end}_N"), given.get(f"tension_{end}z_N")
        if total is not None:
            for name, part in (("x", given.get("tension_x_N")), (f"{end}z", vertical)):
                if part is not None and total <= abs(part):
                    return (
                        f"tension_{end}_N of {total:.6g} N must exceed its component "
                        f"tension_{name}_N of {part:.6g} N"
                    )
            other_N = total + (w if end == "1" else -w) * given.get("rise_m", 0.0)
            if other_N <= 0.0:
                other = "31"[int(end) // 2]
                return (
                    f"with tension_{end}_N of {total:.6g} N and rise_m of {given['rise_m']:.6g} m "
                    f"the tension at end {other} would be {other_N:.6g} N; raise the tension"
                )
    V_1, V_3 = given.get("tension_1z_N"), given.get("tension_3z_N")
    if V_1 is not None and V_3 is not None and V_3 <= V_1:
        return f"tension_3z_N of {V_3:.6g} N must exceed tension_1z_N of {V_1:.6g} N by the weight"
    return ""


def _lengths(w: float, given: dict[str, float]) -> str:
    """Bounds between the length and its projections."""
    V_1, V_3 = given.get("tension_1z_N"), given.get("tension_3z_N")
    s, name = given.get("length_m"), "length_m"
    if s is None and V_1 is not None and V_3 is not None:
        s, name = (V_3 - V_1) / w, "the length (tension_3z_N - tension_1z_N)/weight"
    z = given.get("rise_m")
    if s is None:
        return ""
    if "span_m" in given or z is not None:
        chord = float(np.hypot(given.get("span_m", 0.0), z or 0.0))
        if s <= chord:
            return (
                f"{name} of {s:.6g} m must exceed the distance of {chord:.6g} m that it spans; a "
                "straight cable would need infinite tension; give a longer one, or nearer ends"
            )
    if z == 0.0 and (V_1 is not None or V_3 is not None):
        return (
            "with rise_m 0 the vertical tensions are half the weight for any tension; give "
            "span_m or a tension instead"
        )
    return ""


def _weight_bound(w: float, given: dict[str, float]) -> str:
    """Lower bounds of the tension: |T_1| > w (ds - dz)/2, |T_3| > w (ds + dz)/2."""
    s, z = given.get("length_m"), given.get("rise_m")
    if s is None or z is None:
        return ""
    for end, sign in (("1", -1.0), ("3", 1.0)):
        tension = given.get(f"tension_{end}_N")
        bound = 0.5 * w * (s + sign * z)
        if tension is not None and tension <= bound:
            return (
                f"tension_{end}_N is {tension:.6g} N; a cable of {s:.6g} m and rise {z:.6g} m "
                f"needs more than {bound:.6g} N to carry its own weight"
            )
    return ""


def _span_bound(w: float, given: dict[str, float]) -> str:
    """Bounds of the length, the tension or the span."""
    from scipy.optimize import minimize_scalar  # noqa: PLC0415  slow to load, needed for errors

    X = w * given.get("span_m", np.nan)
    H, s = given.get("tension_x_N"), given.get("length_m")
    if H is not None and s is not None:
        with np.errstate(over="ignore"):
            least = float(2.0 * H / w * np.sinh(0.5 * X / H))
        return (
            (
                f"length_m is {s:.6g} m; with tension_x_N of {H:.6g} N a cable over span_m "
                f"{given['span_m']:.6g} m is at least {least:.6g} m long"
            )
            if s <= least
            else ""
        )
    named = next((n for n in ("tension_1_N", "tension_3_N") if n in given), "")
    if named and given.keys() == {"span_m", "rise_m", named}:
        Z = w * given["rise_m"]

        def tension_sum(ln_d: float) -> float:
            d = np.exp(ln_d)
            return float(np.hypot(X * np.sinh(d) / d, Z) / np.tanh(d))

        least = float(minimize_scalar(tension_sum, bounds=(-20.0, 5.0), method="bounded").fun)
        bound = 0.5 * (least - Z if named == "tension_1_N" else least + Z)
        return (
            f"{named} is {given[named]:.6g} N; a cable over span {given['span_m']:.6g} m and rise "
            f"{given['rise_m']:.6g} m, however long, needs {bound:.6g} N or more"
        )
    if named and given.keys() == {"span_m", "length_m", named}:
        t = given[named] / (w * given["length_m"])

        def span(angle: float) -> float:
            t_far = np.sqrt(1.0 + t * t + 2.0 * t * np.sin(angle))
            return float(2.0 * t * np.cos(angle) * np.arctanh(1.0 / (t + t_far)))

        widest = minimize_scalar(
            lambda angle: -span(angle), bounds=(-1.57, 1.57), method="bounded"
        )
        return (
            f"with {named} of {given[named]:.6g} N a cable of {given['length_m']:.6g} m reaches "
            f"at most span_m {-widest.fun * given['length_m']:.6g}, not {given['span_m']:.6g}"
        )
    return ""
