"""Arm of CiA-402 drives on CANopen: `arm` moves it, `options` and `objects` check, `setup` configures, `states`, `sync` track."""
