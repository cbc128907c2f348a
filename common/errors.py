"""Errors a user can mend: one line that says what was wrong, where, and what to do."""


class UserError(Exception):
    """Shown as one line, without a traceback; the process ends with status 2."""
