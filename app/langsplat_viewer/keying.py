"""Giving commands other keys than those of the table in `commands`; kept in the preferences."""

from dataclasses import replace

from langsplat_viewer.commands import COMMANDS, Command, keys_of
from langsplat_viewer.keys import Changed, Conflict, problem
from langsplat_viewer.viewer import Viewer


def command_of(does: str) -> Command:
    """The one that does it. KeyError where there is none."""
    return {command.does: command for command in COMMANDS}[does]


def can_change(command: Command) -> bool:
    """Whether its keys can be others: those of Esc are not."""
    return "Esc" not in command.keys


def wait_for_key(viewer: Viewer, command: Command | None) -> None:
    """Have a command take the key that is pressed next; None: no longer."""
    waiting = "" if command is None else command.does
    viewer.state.keying = replace(viewer.state.keying, waiting=waiting, conflict=None)


def press(viewer: Viewer, key: str) -> None:
    """The key that was waited for. One that is taken is asked about, one that cannot be had is refused."""
    command = command_of(viewer.state.keying.waiting)
    wait_for_key(viewer, None)
    changed = viewer.state.preferences.keys
    refused = problem(key)
    if refused:
        viewer.state.say(f"'{command.does}' keeps its key: {refused}", is_error=True)
        return
    owners = [other for other in COMMANDS if key in keys_of(other, changed) and other is not command]
    if owners:
        conflict = Conflict(command.does, key, owners[0].does)
        viewer.state.keying = replace(viewer.state.keying, conflict=conflict)
    else:
        _keep(viewer, {command.does: (key,)})


def swap(viewer: Viewer) -> None:
    """Give the key to the command that wants it, whose own keys go to the one that had it."""
    conflict = viewer.state.keying.conflict
    if conflict is None:
        return
    viewer.state.keying = replace(viewer.state.keying, conflict=None)
    changed = viewer.state.preferences.keys
    own = keys_of(command_of(conflict.wanted_by), changed)
    others = keys_of(command_of(conflict.owner), changed)
    left = tuple(key for key in (*others, *own) if key != conflict.key)
    _keep(viewer, {conflict.wanted_by: (conflict.key,), conflict.owner: left})


def keep_keys(viewer: Viewer) -> None:
    """Leave the key with the command that has it."""
    viewer.state.keying = replace(viewer.state.keying, conflict=None)


def clear(viewer: Viewer, command: Command) -> None:
    """No key for it."""
    _keep(viewer, {command.does: ()})


def put_back(viewer: Viewer, command: Command) -> None:
    """Its keys of the table again, but for those that another command was given."""
    others = {does: keys for does, keys in viewer.state.preferences.keys.items() if does != command.does}
    _set(viewer, others)
    missing = set(command.keys) - set(keys_of(command, others))
    if missing:
        owners = {key: does for does, keys in others.items() for key in keys}
        taken = ", ".join(f"{key} is the key of '{owners[key]}'" for key in sorted(missing))
        viewer.state.say(f"not given back: {taken}")


def put_all_back(viewer: Viewer) -> None:
    """All keys as in the table."""
    _set(viewer, {})


def _keep(viewer: Viewer, keys: Changed) -> None:
    _set(viewer, {**viewer.state.preferences.keys, **keys})


def _set(viewer: Viewer, changed: Changed) -> None:
    """Without those that are as in the table."""
    table = {command.does: command.keys for command in COMMANDS}
    other = {does: keys for does, keys in changed.items() if table.get(does) != keys}
    viewer.state.preferences = replace(viewer.state.preferences, keys=other)
