"""Images: found, read upright, undistorted and fitted, with the geometry held against OpenCV's projection."""

import struct
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from idesplat.runtime.cameras.camera import Camera
from idesplat.runtime.cameras.undistortion import undistort, undistortion_valid_mask
from idesplat.runtime.errors import InputError
from idesplat.runtime.images.finding import describe_unsupported, find_images, unsupported_images
from idesplat.runtime.images.io import load_image
from idesplat.runtime.images.resizing import cover_crop, frame_crop, resize_and_crop
from idesplat.runtime.images.sizes import whole_frame_size

# rows of the upright image, in RGB: red, green / blue, white / grey, black
UPRIGHT = np.array(
    [[[250, 10, 10], [10, 250, 10]], [[10, 10, 250], [250, 250, 250]], [[128, 128, 128], [5, 5, 5]]], np.uint8
)
# What a camera stores so that its EXIF orientation turns it upright (EXIF 2.32, tag 0x0112).
STORED = {
    1: lambda up: up,
    2: lambda up: up[:, ::-1],
    3: lambda up: up[::-1, ::-1],
    4: lambda up: up[::-1],
    5: lambda up: up.transpose(1, 0, 2),
    6: lambda up: np.rot90(up, 1),
    7: lambda up: up.transpose(1, 0, 2)[::-1, ::-1],
    8: lambda up: np.rot90(up, -1),
}


def exif_jpeg(rgb, orientation):
    """A JPEG with one EXIF tag: marker, length, then a big-endian TIFF header and directory of one entry."""
    bgr = np.ascontiguousarray(rgb[..., ::-1])
    content = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, 100])[1].tobytes()
    directory = struct.pack(">2sHI", b"MM", 42, 8) + struct.pack(">HHHIHHI", 1, 0x0112, 3, 1, orientation, 0, 0)
    segment = b"Exif\0\0" + directory
    return content[:2] + b"\xff\xe1" + struct.pack(">H", len(segment) + 2) + segment + content[2:]


def save(path, rgb, *params):
    assert cv2.imwrite(str(path), np.ascontiguousarray(rgb[..., [2, 1, 0, *range(3, rgb.shape[2])]]), params)
    return path


# ---- finding


def touch(folder, *names):
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"")


def test_folder_is_sorted_naturally_and_only_images(tmp_path):
    touch(tmp_path, "img10.png", "img2.PNG", "IMG1.jpg", "img2b.jpg", "notes.txt", ".hidden.jpg", "sub/img3.png")
    assert [path.name for path in find_images([tmp_path])] == ["IMG1.jpg", "img2.PNG", "img2b.jpg", "img10.png"]


def test_globs_and_files_each_once(tmp_path):
    touch(tmp_path, "a/1.png", "a/2.jpg", "b/1.png", "b/1.txt", "a/[1].png")
    found = find_images([f"{tmp_path}/*/1.*", tmp_path / "a" / "1.png", str(tmp_path / "a" / "[1].png")])
    assert [str(path.relative_to(tmp_path)) for path in found] == ["a/1.png", "a/[1].png", "b/1.png"]


def test_nothing_found_is_an_error(tmp_path):
    touch(tmp_path, "empty/notes.txt", "photo.dng", "raw/photo.dng")
    for given_, expected in (
        ([], "no images given"),
        ([tmp_path / "empty"], "empty: no images in this folder"),
        ([tmp_path / "absent.jpg"], "absent.jpg: no such file"),
        ([str(tmp_path / "*.gif")], "no such file or folder, nor a pattern"),
        ([str(tmp_path / "*.dng")], "matches no images, but 1 of formats that are not read"),
        ([tmp_path / "raw"], "raw: no images in this folder, but 1 of formats that are not read"),
        ([tmp_path / "photo.dng"], "photo.dng: not an image by its suffix"),
    ):
        with pytest.raises(InputError, match=expected):
            find_images(given_)


@given(names=st.lists(st.text(st.sampled_from("ab01²٣.-"), min_size=1), unique=True, min_size=1, max_size=6))
@settings(max_examples=50)
def test_any_names_can_be_sorted(tmp_path_factory, names):
    folder = tmp_path_factory.mktemp("names")
    touch(folder, *(f"x{name}.png" for name in names))
    assert {path.name for path in find_images([folder])} == {f"x{name}.png" for name in names}


def test_a_file_is_found_once_under_any_path(tmp_path):
    touch(tmp_path, "a/1.png", "b/2.png")
    found = find_images([tmp_path / "a", tmp_path / "b" / ".." / "a" / "1.png", tmp_path / "b"])
    assert [path.name for path in found] == ["1.png", "2.png"]


def test_images_that_are_not_read_are_named(tmp_path):
    touch(tmp_path, "1.jpg", "2.heic", "IMG_2.DNG", "IMG_1.cr2", "a.gif", "z.nef", "._x.dng", "notes.txt", "data.npz")
    assert [path.name for path in find_images([tmp_path])] == ["1.jpg", "2.heic"]
    assert [path.name for path in unsupported_images([tmp_path])] == ["a.gif", "IMG_1.cr2", "IMG_2.DNG", "z.nef"]
    assert describe_unsupported([str(tmp_path / "I*")]) == [
        "2 images are of an unsupported format, and left out: IMG_1.cr2, IMG_2.DNG; save as JPEG or PNG"
    ]
    assert describe_unsupported([tmp_path / "1.jpg"]) == []


# ---- reading


@pytest.mark.parametrize("orientation", STORED)
def test_exif_rotation_is_applied(tmp_path, orientation):
    upright = UPRIGHT.repeat(16, axis=0).repeat(16, axis=1)  # JPEG blocks of one colour survive compression
    path = tmp_path / "photo.jpg"
    path.write_bytes(exif_jpeg(STORED[orientation](upright), orientation))
    image = load_image(path)
    assert image.shape == upright.shape and image.dtype == np.uint8
    np.testing.assert_allclose(image[8::16, 8::16].astype(int), UPRIGHT.astype(int), atol=6)


@pytest.mark.parametrize("suffix", [".png", ".webp", ".tiff", ".bmp", ".ppm"])
def test_colours_come_back_in_rgb(tmp_path, suffix):
    path = save(tmp_path / f"a{suffix}", UPRIGHT, *((cv2.IMWRITE_WEBP_QUALITY, 101) if suffix == ".webp" else ()))
    np.testing.assert_array_equal(load_image(path), UPRIGHT)


def test_grey_becomes_rgb(tmp_path):
    grey = np.arange(6, dtype=np.uint8).reshape(2, 3) * 40
    for name in ("g.png", "g.pgm"):
        cv2.imwrite(str(tmp_path / name), grey)
        np.testing.assert_array_equal(load_image(tmp_path / name), np.stack([grey] * 3, axis=-1))


def test_sixteen_bits_are_scaled(tmp_path):
    values = np.array([[0, 128, 129, 257, 32768, 65535]], np.uint16)
    cv2.imwrite(str(tmp_path / "deep.png"), values)
    np.testing.assert_array_equal(load_image(tmp_path / "deep.png")[0, :, 0], [0, 0, 1, 1, 128, 255])


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_transparency_is_laid_on_white(tmp_path, dtype):
    unit = np.iinfo(dtype).max // 255
    rgba = np.array([[[200, 100, 0, 255], [200, 100, 0, 0], [200, 100, 0, 51]]], dtype) * dtype(unit)
    path = save(tmp_path / "clear.png", rgba)
    np.testing.assert_array_equal(load_image(path)[0], [[200, 100, 0], [255, 255, 255], [244, 224, 204]])


@pytest.mark.skipif(not hasattr(cv2, "imencodeWithMetadata"), reason="OpenCV before 4.11 writes no metadata")
def test_transparency_with_rotation_is_turned(tmp_path):
    tag = struct.pack(">2sHI", b"MM", 42, 8) + struct.pack(">HHHIHHI", 1, 0x0112, 3, 1, 6, 0, 0)
    rgba = np.concatenate([UPRIGHT, UPRIGHT[..., :1]], axis=-1)
    exif = [np.frombuffer(tag, np.uint8)]
    content = cv2.imencodeWithMetadata(".png", rgba, [cv2.IMAGE_METADATA_EXIF], exif)[1]
    (tmp_path / "a.png").write_bytes(content.tobytes())
    opacity = UPRIGHT[..., :1] / 255  # red was taken for it
    expected = np.rot90(UPRIGHT[..., ::-1] * opacity + 255 * (1 - opacity), -1)
    np.testing.assert_allclose(load_image(tmp_path / "a.png"), expected, atol=0.51)


def test_what_cannot_be_read(tmp_path):
    cv2.imwrite(str(tmp_path / "float.tiff"), np.ones((2, 2, 3), np.float32))
    save(tmp_path / "whole.png", UPRIGHT.repeat(20, axis=0))
    (tmp_path / "cut.png").write_bytes((tmp_path / "whole.png").read_bytes()[:40])
    (tmp_path / "text.jpg").write_text("not an image")
    (tmp_path / "empty.jpg").write_bytes(b"")
    for name, expected in (
        ("float.tiff", "holds float32"),
        ("cut.png", "damaged"),
        ("text.jpg", "damaged"),
        ("empty.jpg", "empty.jpg: is empty"),
        ("absent.jpg", "cannot be read"),
        (".", "is a folder"),
    ):
        with pytest.raises(InputError, match=expected):
            load_image(tmp_path / name)


# ---- geometry

POINTS = np.array([[x, y, 2.0 + 0.5 * x] for x in (-0.5, 0.1, 0.6) for y in (-0.55, 0.0, 0.5)])  # camera frame


def blobs(height, width, centres, sigma):
    """A black image with a soft dot at each centre (pixel centres at .5), sampled at the pixel centres."""
    y, x = np.mgrid[:height, :width] + 0.5
    image = sum(np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * sigma**2)) for cx, cy in centres)
    return np.repeat(np.rint(255 * np.minimum(image, 1)).astype(np.uint8)[..., None], 3, axis=2)


def centroid(image, around, radius):
    """Centre of a dot, in pixels with centres at .5, of an image [height, width].

    Weights are squared, so that 8-bit rounding in the dot's wide skirt counts little.
    """
    y, x = np.mgrid[: image.shape[0], : image.shape[1]] + 0.5
    weight = np.where(np.hypot(x - around[0], y - around[1]) < radius, image.astype(float) ** 2, 0)
    return np.array([(weight * x).sum(), (weight * y).sum()]) / weight.sum()


def project(K, points=POINTS):
    pixels = points @ K.T
    return pixels[:, :2] / pixels[:, 2:]


@pytest.mark.parametrize(
    ("width", "height", "target_width", "target_height"),
    [
        (640, 480, 256, 256),  # landscape, smaller
        (481, 643, 256, 256),  # portrait with odd sides
        (480, 640, 448, 256),  # portrait into landscape
        (643, 481, 320, 448),  # landscape into portrait
        (200, 150, 448, 320),  # larger, nearly the same shape: stretched
        (640, 480, 448, 256),  # another shape: cropped
        (256, 256, 256, 256),  # as it is
    ],
)
def test_fit_keeps_every_projection(width, height, target_width, target_height):
    focal = 1.1 * min(width, height)
    K = np.array([[focal, 0, 0.47 * width], [0, 1.02 * focal, 0.55 * height], [0, 0, 1]])
    sigma = 0.016 * min(width, height)
    image = blobs(height, width, project(K), sigma)
    fitted, intrinsics = resize_and_crop(image, K, target_height, target_width)
    assert fitted.shape == (3, target_height, target_width) and fitted.dtype == np.float32
    assert fitted.min() >= 0 and fitted.max() <= 1 and intrinsics.dtype == np.float32
    crop = frame_crop(width, height, target_width, target_height)
    radius = 4.5 * sigma * crop.scale_x
    centres = project(np.diag([target_width, target_height, 1]) @ intrinsics.astype(np.float64))
    inside = [
        all(radius < value < side - radius for value, side in zip(centre, (target_width, target_height), strict=True))
        for centre in centres
    ]
    assert sum(inside) >= 3
    for centre, original in zip(centres[inside], project(K)[inside], strict=True):
        np.testing.assert_allclose(centroid(fitted[0], centre, radius), centre, atol=0.01)
        np.testing.assert_allclose((crop.matrix @ [*original, 1])[:2], centre, atol=1e-3)


def test_images_of_nearly_the_target_shape_are_whole_and_others_are_cropped():
    whole = frame_crop(400, 300, 288, 224)
    assert (whole.width, whole.height, whole.left, whole.top) == (288, 224, 0, 0)
    assert frame_crop(400, 300, 256, 256) == cover_crop(400, 300, 256, 256)


@given(st.floats(0.3, 3.0), st.integers(40_000, 600_000), st.sampled_from([14, 16, 32]))
@example(0.375, 49_153, 32)
@example(0.3, 40_000, 32)
def test_the_size_of_a_whole_frame_has_its_shape_and_no_fewer_pixels(aspect, area, multiple):
    height, width = whole_frame_size(aspect, area, multiple)
    assert height % multiple == width % multiple == 0
    assert area <= height * width <= (1.3 if area >= 65_536 else 1.5) * area
    crop = frame_crop(1200, round(1200 * aspect), width, height)
    assert crop.left == crop.top == 0 and (crop.width, crop.height) == (width, height)


@pytest.mark.parametrize("distortion", [(0.1, -0.05, 0.002, -0.003), (-0.15, 0.03, 0.0, 0.004)])
def test_undistort_against_opencv_projection(distortion):
    K = np.array([[400.0, 0, 300.3], [0, 405.0, 260.7], [0, 0, 1]])
    camera = Camera("a", 620, 500, K, np.eye(4), distortion)
    opencv_K = K - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])  # pixel centres at whole numbers
    seen = cv2.projectPoints(POINTS, np.zeros(3), np.zeros(3), opencv_K, np.array(distortion))[0][:, 0] + 0.5
    straight, pinhole = undistort(blobs(500, 620, seen, 3), camera)
    assert pinhole.distortion is None and pinhole.K is camera.K and straight.shape == (500, 620, 3)
    expected = project(K)
    assert np.abs(expected - seen).max() > 1  # the lens does something
    for centre in expected:
        # OpenCV's remap rounds positions to 1/32 pixel
        np.testing.assert_allclose(centroid(straight[..., 0], centre, 13), centre, atol=1 / 64)


def test_what_the_lens_saw_against_opencv_projection():
    """A pixel of the undistorted image was seen if its ray, distorted by the lens, meets the input image."""
    K = np.array([[60.0, 0, 48], [0, 60, 36], [0, 0, 1]])
    camera = Camera("a", 96, 72, K, np.eye(4), (0.2, 0.05, 0.002, -0.001))
    x, y = np.meshgrid(np.arange(96) + 0.5, np.arange(72) + 0.5)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3) @ np.linalg.inv(K).T
    bent = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), K, np.array(camera.distortion))[0].reshape(72, 96, 2)
    # the input image has no colour beyond its outermost pixel centres
    expected = ((bent > 0.5) & (bent < (95.5, 71.5))).all(axis=-1)
    assert 0.5 < expected.mean() < 0.95
    assert (undistortion_valid_mask(camera) == expected).mean() > 0.999
    assert undistortion_valid_mask(replace(camera, distortion=None)).all()


def test_undistort_fisheye_against_opencv_projection():
    K = np.array([[250.0, 0, 300.3], [0, 253.0, 260.7], [0, 0, 1]])
    distortion = (0.05, -0.01, 0.004, -0.001)
    camera = Camera("a", 620, 500, K, np.eye(4), distortion, fisheye=True)
    opencv_K = K - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])  # pixel centres at whole numbers
    points = POINTS[:, None]
    seen = cv2.fisheye.projectPoints(points, np.zeros(3), np.zeros(3), opencv_K, np.array(distortion))[0][:, 0] + 0.5
    straight, pinhole = undistort(blobs(500, 620, seen, 3), camera)
    assert pinhole.distortion is None and not pinhole.fisheye and pinhole.K is camera.K
    expected = project(K)
    assert np.abs(expected - seen).max() > 1  # the lens does something
    for centre in expected:
        np.testing.assert_allclose(centroid(straight[..., 0], centre, 13), centre, atol=1 / 32)


def test_undistort_without_distortion_changes_nothing():
    camera = Camera("a", 8, 6, np.array([[9.0, 0, 4], [0, 9, 3], [0, 0, 1]]), np.eye(4))
    image = np.zeros((6, 8, 3), np.uint8)
    assert undistort(image, camera) == (image, camera)
    with pytest.raises(InputError, match="distortion"):
        replace(camera, distortion=(np.nan, 0, 0, 0))


@given(*(st.integers(1, 3000) for _ in range(4)))
@settings(max_examples=200)
def test_cover_always_covers_and_cuts_one_side_only(width, height, target_width, target_height):
    crop = cover_crop(width, height, target_width, target_height)
    assert crop.left >= 0 and crop.left + target_width <= crop.width
    assert crop.top >= 0 and crop.top + target_height <= crop.height
    assert crop.width == target_width or crop.height == target_height
    assert abs(crop.scale_x * height - crop.scale_y * height) <= max(1, height / width)  # aspect kept to a pixel
