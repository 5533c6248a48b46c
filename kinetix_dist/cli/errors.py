"""How a command fails because of what it was given: a `UserError` is one line on stderr and exit code 2."""

from kinetix_dist.errors import UserError, one_line, user_errors

__all__ = ["EXIT_USER_ERROR", "UserError", "one_line", "user_errors"]

EXIT_USER_ERROR = 2
