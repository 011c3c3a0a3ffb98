"""What faults are put into, which tests have to notice them, and which change no behaviour."""

from typing import NamedTuple


class Area(NamedTuple):
    """Source files of one subject, and the names of its test files, the quickest first."""

    files: tuple[str, ...]
    tests: tuple[str, ...]


AREAS: dict[str, Area] = {
    "cost": Area(
        ("estune/core/cost.py", "estune/core/metrics.py", "estune/trial/scoring.py"),
        ("cost", "metrics", "score", "ramp", "cost_presets", "oscillation"),
    ),
    "seeking": Area(
        (
            "estune/tuners/extremum_seeking.py",
            "estune/tuners/killingsworth.py",
            "estune/tuners/least_squares_gradient.py",
            "estune/tuners/observation.py",
            "estune/tuners/perturbation.py",
            "estune/tuners/search_space.py",
            "estune/tuners/step_control.py",
        ),
        ("search_space", "tuners", "result_warnings"),
    ),
    "margins": Area(
        ("estune/core/margins.py", "estune/loop_model/margins.py"),
        ("interop", "loop_margins", "loop_records", "loop_model"),
    ),
    "limits": Area(
        (
            "estune/trial/description.py",
            "estune/trial/record_checks.py",
            "estune/run/limit_verdict.py",
        ),
        (
            "score",
            "profiles",
            "limit_verdict",
            "rig_limits",
            "cost_presets",
            "gain_bounds",
            "daemon_service",
            "scaled_units",
        ),
    ),
    "lease": Area(
        (
            "estune/remote/state_machine/rig.py",
            "estune/remote/state_machine/client.py",
            "estune/remote/zenoh/client_lease.py",
        ),
        ("client_lease", "link", "state_tables", "request_handler", "link_exchange"),
    ),
    "ledger": Area(
        ("estune/remote/ledger.py", "estune/remote/state_machine/trials.py"),
        ("link", "ledger", "request_handler", "stored_formats"),
    ),
    "restore": Area(
        (
            "estune/hardware/reel_machine/transitions.py",
            "estune/hardware/reel_machine/machine.py",
            "estune/run/loop.py",
            "estune/run/failed_trials.py",
            "estune/remote/zenoh/trial_execution.py",
        ),
        (
            "machine",
            "machine_readings",
            "hybrid_control",
            "tuning",
            "request_handler",
            "request_handler_stops",
            "extended_search",
            "controller_form",
            "prove",
            "model_based",
        ),
    ),
    "guard": Area(
        ("estune/reel/guard.py", "estune/hardware/guard_watch.py"),
        ("guard", "machine", "machine_readings"),
    ),
    "verdict": Area(
        ("plants/diagnosis/search/decide.py", "plants/diagnosis/search/conclusion.py"),
        ("decide", "conclusion", "explain_report", "explain_friction"),
    ),
    "intervals": Area(
        (
            "estune/core/comparison.py",
            "estune/loop_model/intervals.py",
            "estune/run/confirmation.py",
            "plants/diagnosis/search/intervals.py",
        ),
        ("comparison", "intervals", "loop_intervals", "session", "loop_records", "loop_model"),
    ),
    "proof": Area(
        (
            "estune/proof/patch.py",
            "estune/proof/trials.py",
            "estune/trial/tracking.py",
            "plants/remedies/offers.py",
        ),
        ("prove", "behaviour", "remedies"),
    ),
}

UNCHANGED: dict[tuple[str, str], str] = {
    (
        "rounding = ROUNDING * float(np.abs(asked).max())",
        "min and max exchanged",
    ): "it counts only where all values are within a thousandth of each other",
    (
        "pairs = [m for m in named if len(m.names) == 2]",
        "condition replaced",
    ): "the best single one does not beat itself, and no pair is of one family",
    (
        "weight = [math.exp(-0.5 * (cost - min(L))) for cost in L]",
        "min and max exchanged",
    ): "their ratios alone count, which the allowance for a wrong form bounds",
    (
        "fitted = {fit.effects[0].name: fit for fit in models.singles}",
        "first and last exchanged",
    ): "a single fit has one effect",
    (
        "effect = fit.effects[0]",
        "first and last exchanged",
    ): "a single fit has one effect",
    (
        'return _title(models, nameless[0]) if nameless else ""',
        "first and last exchanged",
    ): "a model has one nameless law at most",
    (
        "if load is not None and self.rejection > 0.0:",
        "part of a condition dropped",
    ): "a weight of the rejection without a load is refused before",
    (
        "return LoopResponse(grid.theta[0], controller[0], loop[0], stable)",
        "first and last exchanged",
    ): "each has one row, that of the one loop",
    (
        "if isinstance(event, events.Expire):",
        "guard dropped",
    ): "a lease that has expired does so once",
    (
        "digest, state, frame, error, sentence = rows[0]",
        "first and last exchanged",
    ): "the ids of trials are unique: the query gives one row at most",
    (
        "sequence, size = oldest[0]",
        "first and last exchanged",
    ): "the query gives one row at most",
    (
        "parts = np.array_split(later, max(1, later.size * self.C.size**2 // 2**20))",
        "power dropped",
    ): "it decides the memory for a response, not its value",
    (
        "delay = math.floor(dead_time_s / sample_s + 1e-9)  # a whole number in spite of rounding",
        "constant scaled",
    ): "rounding is far below it",
    (
        "fraction_s = max(0.0, dead_time_s - delay * sample_s)",
        "clamp dropped",
    ): "it is below zero by rounding alone, which changes the matrices by as little",
    (
        "low = float(np.clip(1e-3 * rates.min(initial=1.0), 1e-9, 1e-5))",
        "constant scaled",
    ): "any of them is well below the slowest rate, or the upper limit",
    (
        "at_rest = abs(plant.response(np.array([low]))[0])",
        "first and last exchanged",
    ): "one angle has one response",
    (
        "_HELD_WITHIN_S = 1.5 * LEASE_S  # by then the lease of a killed client has expired",
        "arithmetic exchanged",
    ): "a lease is one second",
    (
        "FINEST_TURN_rad = math.pi / 8.0",
        "constant scaled",
    ): "twice as fine a grid",
    (
        "integrator = -np.expm1(-1j * theta) if gains.I > 0.0 else 1.0",
        "constant scaled",
    ): "a real factor turns nothing",
    (
        "low = float(np.clip(1e-3 * slow, 1e-12, low))",
        "constant scaled",
    ): "nothing crosses or turns there: the loop is above 500 and its integrator leads",
    (
        "if RigAction.STOP in move.orders and trial is not None and not trial.is_stopping:",
        "part of a condition dropped",
    ): "the state machine orders the stop of an active trial only, and once",
    (
        "if self.effort_weight > 0.0:",
        "condition replaced",
    ): "a weight of zero adds nothing",
    (
        "place = np.linspace(-1.0, 1.0, len(peak))",
        "constant scaled",
    ): "polynomials over a wider place are the same",
    (
        "if t_s > samples * h * (1.0 + 1e-9):  # the margin is for rounding in samples * h",
        "constant scaled",
    ): "rounding is far below it",
}
"""Faults that change no behaviour, by their line and kind, with the reason."""
