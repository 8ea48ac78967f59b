"""What adapters raise when it is not the cloud that is wrong."""


class GeneratorError(RuntimeError):
    """A generator that cannot be made or did not answer: a package, a checkpoint or a process is at fault."""
