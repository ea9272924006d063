"""What a person is told when what they gave makes no sense."""


class InputError(ValueError):
    """Something from outside is wrong: data, a file, an argument, a name.

    Its message is one sentence that names the thing and the remedy; the command prints it and exits with code 2.
    Everything that is raised because of what a user gave is of this type, so that nothing else is ever mistaken for it.
    """
