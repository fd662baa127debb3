"""`python -m simbackend.world_process FD_PIPE FD_IMAGE`: one world that serves one pipe until it closes."""

from __future__ import annotations

import contextlib
import mmap
import os
import signal
import sys
from multiprocessing.connection import Connection

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from hal.arrays import Array
from hal.cpu_affinity import share_core
from simbackend.wire import CAMERA_AT, DOUBLE, IMAGE_BYTES, REQUEST, Op, PictureInfo, PictureType, read_exactly
from simbackend.world import World


def serve(pipe: Connection, images: mmap.mmap) -> None:
    """Build the world described by the first message, then answer requests until the pipe closes."""
    try:
        config = pipe.recv()
        if config.cell.file.cell.mode == "sim":
            share_core(os.getppid())
        world = World(config)
    except Exception as error:  # whatever prevents a world from being built must reach the user who started it
        pipe.send(f"{type(error).__name__}: {error}")
        return
    first = world.snapshot()
    pipe.send((REQUEST, len(first)))
    stream = pipe.fileno()
    os.write(stream, first.tobytes())
    while True:
        try:
            message = read_exactly(stream, REQUEST * DOUBLE)
        except (EOFError, OSError):
            break
        request = np.frombuffer(message)
        match Op(int(request[0])):
            case Op.STEP:
                os.write(stream, world.step(request).tobytes())
            case Op.RENDER:
                pipe.send(picture(world, request, images))
            case Op.TRUTH:
                pipe.send(world.truth(float(request[1])))
            case Op.EVENT:
                world.happen(int(request[1]), float(request[2]))
                pipe.send(None)
            case Op.SHOW:
                world.show(int(request[1]), float(request[2]))
                pipe.send(None)
            case Op.CLOSE:
                break
    world.close()


def picture(world: World, request: Array, images: mmap.mmap) -> PictureInfo:
    """Render into the shared memory."""
    width, height, near_m, fx, fy, cx, cy, kind = (float(x) for x in request[1:CAMERA_AT])
    matrix = np.eye(4)
    matrix[:3] = request[CAMERA_AT : CAMERA_AT + 12].reshape(3, 4)
    base_from_camera = world.flange() * RigidTransform.from_matrix(matrix)
    radiance, inverse_depth = world.scene.draw(
        base_from_camera,
        width=int(width),
        height=int(height),
        focal=(fx, fy),
        centre=(cx, cy),
        near_m=near_m,
        channels=int(kind),
    )
    if PictureType(int(kind)) is PictureType.DEPTH:
        with np.errstate(divide="ignore"):
            _put(images, np.where(inverse_depth > 0.0, 1.0 / inverse_depth, np.nan).astype(np.float32))
    else:
        _put(images, radiance)
    return PictureInfo(
        tick=world.tick,
        stamp_s=world.tick * world.dt_s,
        camera_from_base=base_from_camera.inv(),
        base_from_panel=world.panel.base_from_panel,
        lit=world.panel.emitters(),
    )


def _put(images: mmap.mmap, array: NDArray[np.float32]) -> None:
    np.frombuffer(images, np.float32, array.size).reshape(array.shape)[:] = array


def main() -> None:
    """Run the world process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is handled by the parent, which closes the pipe
    pipe_fd, image_fd = int(sys.argv[1]), int(sys.argv[2])
    gone = contextlib.suppress(BrokenPipeError, ConnectionResetError)  # the client has died
    with mmap.mmap(image_fd, IMAGE_BYTES) as images, Connection(pipe_fd) as pipe, gone:
        serve(pipe, images)


if __name__ == "__main__":
    main()
