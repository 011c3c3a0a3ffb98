"""Model-based searches on plants inside and outside the class of the identified loop."""

from experiments.loop_claims.truth import true_sensitivity

__all__ = ["true_sensitivity"]
