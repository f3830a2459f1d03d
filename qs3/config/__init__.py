"""Hydra: resolvers, composing, hashing and checking of configs; knows where `conf/` is."""
