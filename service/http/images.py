"""`/v1/images`: stores images, which requests then name by their ids."""

from __future__ import annotations

import functools
from typing import Annotated, Any

from fastapi import APIRouter, Path, Request
from pydantic import BaseModel, Field
from starlette.responses import FileResponse, Response

from service.http.problems import RESPONSES, refuse_body
from service.http.state import Admitted, AppState, State
from service.knowledge.images import MEDIA, ImageStore, StoredImage

router = APIRouter(prefix="/v1/images", tags=["images"], responses=RESPONSES)
ImageName = Annotated[str, Path(max_length=64, examples=["3f9c2a7be01d4c553f9c2a7b"])]
BODY: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "content": {media: {"schema": {"type": "string", "format": "binary"}} for media in MEDIA.values()},
    }
}


class ImageView(BaseModel):
    """A stored image. Pixel (0, 0) is the middle of the upper left pixel, after rotation by the EXIF orientation."""

    id: str
    width_px: int
    height_px: int
    size_bytes: int
    stored_s: Annotated[float, Field(description="wall time, seconds since 1970")]
    url: str

    @classmethod
    def of(cls, image: StoredImage) -> ImageView:
        """Return the view of a stored image."""
        return cls(
            id=image.id,
            width_px=image.width_px,
            height_px=image.height_px,
            size_bytes=image.size_bytes,
            stored_s=image.stored_s,
            url=f"/v1/images/{image.id}",
        )


class ImageList(BaseModel):
    """Stored images, newest first."""

    images: list[ImageView]


def store_of(state: AppState) -> ImageStore:
    """Return the image store of this service."""
    return ImageStore(state.service.runs_dir)


@router.get("", summary="Stored images, newest first", operation_id="list_images")
async def list_images(state: State) -> ImageList:
    kept = await state.in_thread(store_of(state).all)
    return ImageList(images=[ImageView.of(image) for image in kept])


@router.post("", status_code=201, summary="Store a PNG, JPEG or BMP", operation_id="store_image", openapi_extra=BODY)
async def store_image(state: State, _holder: Admitted, request: Request, response: Response) -> ImageView:
    """The body is the file itself: at most 32 MB, 40 megapixels, 8 bits per channel. The same image has the same id."""
    if request.headers.get("content-type", "").partition(";")[0].strip().lower() not in MEDIA.values():
        # Browsers send other types across origins without a preflight request.
        raise refuse_body(
            415, "the body's type is not an image type", hint=f"Content-Type: {' or '.join(MEDIA.values())}"
        )
    data = await request.body()
    image = ImageView.of(await state.in_thread(functools.partial(store_of(state).add, data)))
    await state.commit("image-stored", {"image": image.id, "size_bytes": image.size_bytes})
    response.headers["Location"] = image.url
    return image


@router.get(
    "/{image_id}",
    summary="The image itself",
    operation_id="fetch_image",
    response_class=FileResponse,
    responses={200: {"content": {media: {} for media in MEDIA.values()}}},
)
async def fetch_image(state: State, image_id: ImageName) -> FileResponse:
    image = await state.in_thread(functools.partial(store_of(state).get, image_id))
    return FileResponse(image.path, media_type=image.media_type, headers={"Cache-Control": "private, max-age=86400"})


@router.delete("/{image_id}", status_code=204, summary="Delete a stored image", operation_id="delete_image")
async def delete_image(state: State, _holder: Admitted, image_id: ImageName) -> None:
    await state.in_thread(functools.partial(store_of(state).remove, image_id))
    await state.commit("image-deleted", {"image": image_id})
