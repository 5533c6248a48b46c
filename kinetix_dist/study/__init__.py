"""Studies: a question, arms that are trained to answer it, and what came out, as files and by one command."""
