"""A reel compared with records: length and preload of each record, parameters, offsets."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from estune.core.quantities import FloatArray
from plants.diagnosis.constants import CONSTANTS
from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.diagnosis.models.calibration import SaggingCalibration
from plants.diagnosis.models.diagnosed_model import DiagnosedModel, Local, free_drum
from plants.diagnosis.models.free_parameters import (
    Slot,
    either_way,
    from_zero,
    of_calibration,
    positive,
)
from plants.diagnosis.models.initial_states import shifted
from plants.effects import Effect
from plants.models.effect_applicability import MOVED_BY_TORQUE
from plants.models.path_structure import GRAVITY_M_S2
from plants.models.reel import Reel
from plants.models.reel_equations import (
    ReelStructure,
    cable_stiffness_N_m,
    drum_stiffness_Nm_rad,
    viscous_friction_Nms,
)


class DiagnosedReel(DiagnosedModel):
    """A `Reel`; its length and preload are those of each record."""

    model: Reel

    def __init__(self, model: Reel, measurements: Sequence[MeasuredRecord]) -> None:
        self.newtons_per_ampere = model.newtons_per_ampere
        self.torque_per_drive = model.torque_constant_Nm_A
        self.has_gauge = any(m.tension_N is not None for m in measurements)
        self.has_encoder = any(m.angle_rad is not None for m in measurements)
        self.placed_by = "angle_rad" if self.has_encoder else "tension_N"
        self.output = "N" if self.has_gauge else "rad"
        self.is_watched = any(m.reference_N is not None for m in measurements)
        super().__init__(model, measurements)

    @property
    def fuller(self) -> "DiagnosedReel | None":
        """The law with full sag, where the records may show the difference from the linear one."""
        if isinstance(self.calibration, SaggingCalibration) or not self._may_sag:
            return None
        sagging = SaggingCalibration(**vars(self.calibration))
        model = replace(self.model, effects=(*self.effects, sagging))
        return DiagnosedReel(model, self.measurements)

    @property
    def is_linear(self) -> bool:
        """Whether the balance of the drum is; with gauge and encoder it needs no cable's law."""
        sags = isinstance(self.calibration, SaggingCalibration)
        return not self.effects and (not sags or (self.has_gauge and self.has_encoder))

    @property
    def _may_sag(self) -> bool:
        """Whether the cable's own weight bends the linear law within the range of the records.

        The linear law has the sag's slope at the preload; further down it differs by
        Q (1/T^2 - 1/T_0^2) - 2 Q (T_0 - T)/T_0^3 in tension, with Q = k w^2 L^3/24.
        """
        for m in self.measurements:
            if m.tension_N is None:
                continue
            preload, Q = self.preload(m), self._sag_N3(m)
            T = max(float(np.quantile(m.tension_N, 0.01)), 0.05 * preload)
            bent = Q * (1.0 / T**2 - 1.0 / preload**2) - 2.0 * Q * (preload - T) / preload**3
            if abs(bent) > CONSTANTS.rounding * preload:
                return True
        return False

    @property
    def is_often_slack(self) -> bool:
        """Whether the cable is slack so often that the torque shows without the tension.

        Slack is where the sag gives more than the stretch: T < (2 Q)^(1/3).
        """
        slack, samples = 0, 0
        for m in self.measurements:
            if m.tension_N is not None:
                least_N = (2.0 * self._sag_N3(m)) ** (1.0 / 3.0)
                slack += int(np.count_nonzero(m.tension_N < least_N))
                samples += m.samples
        return slack > CONSTANTS.small * samples

    def _sag_N3(self, m: MeasuredRecord) -> float:
        """The own weight's Q = k w^2 L^3/24, N^3."""
        at = self._at(m)
        weight_N_m = GRAVITY_M_S2 * at.cable_density_kg_m
        k = float(cable_stiffness_N_m(at, self.preload(m)))
        return k * weight_N_m**2 * at.cable_length_m**3 / 24.0

    @property
    def outputs(self) -> tuple[str, ...]:
        """Gauge, encoder and the gauge outside."""
        return ("tension_N", "angle_rad", "reference_N")

    def length(self, measurement: MeasuredRecord) -> float:
        """Deployed cable length, m."""
        return measurement.cable_length_m or self.model.cable_length_m

    def preload(self, measurement: MeasuredRecord) -> float:
        """The record's preload, or else its mean tension."""
        tension = measurement.tension_N
        for tension_N in (
            measurement.preload_N,
            None if tension is None else float(tension.mean()),
        ):
            if tension_N is not None and math.isfinite(tension_N) and tension_N > 0.0:
                return tension_N
        return self.model.tension_N

    def unavailable(self, effect: type[Effect]) -> str | None:
        """Every effect but those of a load on the axis or of an actuator that has a position."""
        if effect.of_process:
            return MOVED_BY_TORQUE
        return "it is of a load on the axis, not of a cable" if effect.without_cable else None

    def structure(self, effects: tuple[type[Effect], ...]) -> ReelStructure:
        """The reel with these effects."""
        rates = [2.0 * math.pi * self.model.gauge_Hz]
        for m in self.measurements:
            at = self._at(m)
            kappa, J = drum_stiffness_Nm_rad(at, self.preload(m)), at.drum_inertia_kg_m2
            rates += [math.sqrt(kappa / J), viscous_friction_Nms(at) / J]
        return ReelStructure(
            effects=effects,
            fractional=True,
            squarings=self.squarings(2.0 * float(max(rates))),  # it may double in a fit
            rounded=False,
            watched=self.is_watched,
            by_gauge=self.placed_by == "tension_N",
        )

    def _at(self, m: MeasuredRecord) -> Reel:
        """The reel without effects at a record's length."""
        return replace(self.model, cable_length_m=self.length(m), effects=())

    def numbers(self, measurement: MeasuredRecord) -> dict[str, float]:
        """The reel's own numbers at the record's length and rate."""
        return super().numbers(measurement) | {"cable_length_m": self.length(measurement)}

    def turned(self, measurement: MeasuredRecord) -> FloatArray:
        """The angle, read or from the tension."""
        if measurement.angle_rad is not None:
            return measurement.angle_rad
        if measurement.tension_N is None:
            return np.empty(0)
        return measurement.tension_N / self._per_angle(measurement)

    def _calibrations(self) -> list[Slot]:
        r, c = self.model, self.calibration
        lengths = [self.length(m) for m in self.measurements]
        differ = max(lengths) - min(lengths) > CONSTANTS.small * np.mean(lengths)
        # Friction that would damp the reel by a tenth of critical.
        first = self.measurements[0]
        kappa = drum_stiffness_Nm_rad(self._at(first), self.preload(first))
        friction = max(
            r.viscous_friction_Nms, 0.1 * math.sqrt(float(kappa) * r.drum_inertia_kg_m2)
        )
        parameters = [
            positive("drum_inertia_kg_m2", "kg m2", r.drum_inertia_kg_m2),
            from_zero(
                "viscous_friction_Nms", "N m s/rad", r.viscous_friction_Nms, 20.0 * friction
            ),
        ]
        if differ:
            most = 20.0 * max(r.viscous_friction_per_length_Ns, friction / max(lengths))
            start = r.viscous_friction_per_length_Ns
            unit = "N m s/rad per m"
            parameters.append(from_zero("viscous_friction_per_length_Ns", unit, start, most))
            parameters.append(positive("cable_EA_N", "N", r.cable_EA_N))
        # Of one length, the softer of cable and structure stands for both; without gauge or
        # encoder only ratios to the stiffness show.
        soft = not differ and np.mean(lengths) / r.cable_EA_N > 1.0 / r.structure_stiffness_N_m
        if self.has_gauge and self.has_encoder and soft:
            parameters.append(positive("cable_EA_N", "N", r.cable_EA_N))
        elif self.has_gauge and self.has_encoder:
            parameters.append(
                positive("structure_stiffness_N_m", "N/m", r.structure_stiffness_N_m)
            )
        slots = [Slot(free, free.name) for free in parameters]
        if not self.has_gauge:  # only ratios to the torque's gain show
            return slots
        reach = max(self.sizes.torque_max_Nm / r.drum_radius_m, r.tension_max_N)
        offset = either_way("gauge_offset_N", "N", c.gauge_offset_N, reach)
        gain = positive("torque_gain", "", c.torque_gain)
        return [*slots, of_calibration(gain), of_calibration(offset)]

    def slots(self, added: Sequence[type[Effect]]) -> list[Slot]:
        """The free parameters; with the torque's offset where it is identifiable.

        Elsewhere it looks like an offset of the gauge and the encoder.
        """
        slots = super().slots(added)
        laws = (type(self.calibration), *(type(effect) for effect in self.effects), *added)
        identifiable = self.is_often_slack or any(law.by_tension for law in laws)
        if not self.has_gauge or not identifiable:
            return slots
        offset_Nm = self.calibration.torque_offset_Nm
        free = either_way(
            "torque_offset_Nm", "N m", offset_Nm, max(self.sizes.torque_max_Nm, abs(offset_Nm))
        )
        column = f"{len(self.effects) + len(added)}.{free.name}"
        return [*slots, Slot(free, column)]

    def sensors(self) -> list[Slot]:
        """The encoder's zero of each record, and offsets of gauges that are beside the reel's."""
        slots = []
        for n, m in enumerate(self.measurements):
            if m.angle_rad is not None:
                start = self._zero(m)
                reach = 10.0 * max(float(np.ptp(m.angle_rad)), abs(start), 0.1)
                free = either_way(f"encoder_zero_rad[{n}]", "rad", start, reach, f"record {n}")
                slots.append(Slot(free, "angle_zero", record=n))
        if self.is_watched:
            free = either_way("reference_offset_N", "N", 0.0, self.model.tension_max_N)
            slots.append(Slot(free, "reference_offset"))
        return slots

    def _zero(self, m: MeasuredRecord) -> float:
        """The angle read where the cable is just taut, by the mean of the linear law.

        A sample counts by the square of its tension: where the cable is slack the angle is any.
        """
        assert m.angle_rad is not None  # noqa: S101  sensors() asks only then
        per_angle = self._per_angle(m)
        tension, weight = np.full(m.samples, self.preload(m)), np.ones(m.samples)
        if m.tension_N is not None and float(np.max(m.tension_N)) > 0.0:
            tension = m.tension_N
            weight = np.maximum(tension, 0.0) ** 2
        taut = m.angle_rad - (tension - self.calibration.gauge_offset_N) / per_angle
        return float(np.average(taut, weights=weight))

    def _per_angle(self, m: MeasuredRecord) -> float:
        """Tension per angle of the linear law, N/rad."""
        stiffness = float(cable_stiffness_N_m(self._at(m), self.preload(m)))
        return stiffness * self.model.drum_radius_m

    def local(self, measurement: MeasuredRecord) -> Local:
        """Angle and velocity under motor torque less cable torque.

        Friction is the constant; without gauge or encoder, so is all of the torque.
        """
        drum, tension = free_drum(), measurement.tension_N
        if measurement.angle_rad is None or tension is None:
            return drum
        r, rate = self._at(measurement), measurement.sampling_Hz
        drive = shifted(self.command_N(measurement), r.dead_time_s * rate)
        # The tension is a curve through its samples, delayed by the gauge.
        lag_s = r.gauge_damping / (math.pi * r.gauge_Hz)
        pull = shifted(np.nan_to_num(tension), -0.5 - lag_s * rate)
        torque = r.drum_radius_m * (self.calibration.torque_gain * drive - pull)
        return drum._replace(B=drum.B / r.drum_inertia_kg_m2, input=torque)

    @property
    def suggested_horizon_s(self) -> float:
        """A period of drum and cable, at the lowest of the records' frequencies."""
        slowest = min(
            drum_stiffness_Nm_rad(self._at(m), self.preload(m)) for m in self.measurements
        )
        J = self._at(self.measurements[0]).drum_inertia_kg_m2
        return float(2.0 * math.pi / math.sqrt(slowest / J))
