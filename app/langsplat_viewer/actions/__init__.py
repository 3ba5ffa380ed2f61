"""Actions of the viewer: functions that buttons, keys, dropped files and tests call.

Each takes the `Viewer` and changes its state; long work goes to a worker. None of them raises for
something a user did: the reason appears in the messages area.
"""
