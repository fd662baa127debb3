"""A toy device, for which somebody who is new writes a driver from the scaffold.

Manual of the rangefinder RF7: serial line, 57600 baud, 8N1. Commands end with a line feed. `ID?` is answered by
`RF7 VERSION`. `GO` starts 50 lines a second, `STOP` ends them: `$D,ccc,ddddd,sss*XX` and a line feed, with a counter
from 000 to 255, the distance in tenths of a millimetre, the strength of the echo from 000 to 255, and XX the xor of all
characters between `$` and `*`, in hexadecimal. A strength below 20 means no echo. Power-up: no lines are sent.
"""
