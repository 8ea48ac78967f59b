"""Errors of the generator adapters that are not about the cloud."""

from hal.base.errors import Z1Error


class GeneratorError(Z1Error, RuntimeError):
    """Generator that cannot be made or does not answer, because of a package, a checkpoint or a process."""

    default_code = "generator"
