"""The train command: check, load, build, fit, evaluate, write; resume and shared warm-ups."""
