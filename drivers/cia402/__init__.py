"""Arm of CiA-402 drives on CANopen: `arm` moves it, `setup` configures the drives, `states` and `sync` track them."""
