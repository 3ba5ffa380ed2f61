"""Running a program as somebody whom permissions stop: an administrator is stopped by none."""

import ctypes
import os
from collections.abc import Callable

PR_CAPBSET_DROP, CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH = 24, 1, 2  # linux/prctl.h, linux/capability.h


def bound_by_permissions() -> Callable[[], None] | None:
    """`preexec_fn` for `subprocess`: for the administrator, the right to pass over permissions is given up
    before the program starts; other users need nothing."""
    if os.geteuid() != 0:
        return None
    prctl = ctypes.CDLL(None, use_errno=True).prctl

    def give_up() -> None:
        for right in (CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH):
            if prctl(PR_CAPBSET_DROP, right, 0, 0, 0) != 0:
                raise OSError(ctypes.get_errno(), "cannot give up a right")

    return give_up
