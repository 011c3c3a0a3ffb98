"""Which effect is missing: screened, fitted, ranked, judged."""
