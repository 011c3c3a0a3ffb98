"""The law of tuned gains over cable length and tension: regression, its uncertainty, its words."""
