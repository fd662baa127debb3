"""An arm of CiA-402 drives on CANopen: `arm` moves it, `setup` configures its drives, `states` and `sync` say where they are."""
