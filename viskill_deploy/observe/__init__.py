"""Recording, report and what people look at."""
