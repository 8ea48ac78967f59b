"""What adapters raise when it is not the cloud that is wrong."""

from hal.base.errors import Z1Error


class GeneratorError(Z1Error, RuntimeError):
    """A generator that cannot be made or did not answer: a package, a checkpoint or a process is at fault."""

    default_code = "generator"
