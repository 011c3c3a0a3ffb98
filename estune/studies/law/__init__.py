"""Law of tuned gains over cable length and tension, by robust regression."""
