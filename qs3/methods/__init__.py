"""Methods of domain adaptation, one paper a file: losses on a shared classifier."""
