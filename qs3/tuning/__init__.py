"""Numbers of the source's sensor, tuned until its clouds are like an unlabelled target's."""
