"""The version, where a module that writes it down need not import the whole face of qs3."""

VERSION = "0.1.0"
