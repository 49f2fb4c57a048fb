"""The captures to choose frames from: repositories, commits, folders of images, and cameras."""

from dataclasses import dataclass

from .capture import CaptureSource, Crop

ESTIMATED = "estimated"


@dataclass(frozen=True)
class Recipe(CaptureSource):
    """How to make a capture of its images.

    cameras: a path in the repository, or ESTIMATED. first, last, step: the slice of the folder's images, in order.
    excluded: names of images of these that are not used.
    focal: focal length for estimated cameras, as `idesplat cameras estimate` takes it.
    crop: left, top, right and bottom in pixels of what is kept of each image, without a logo for example.
    """

    cameras: str
    first: int = 0
    last: int | None = None
    step: int = 1
    excluded: tuple[str, ...] = ()
    focal: str | None = None
    crop: Crop | None = None


RECIPES = (
    Recipe(
        "office",
        "room",
        "office, computer tower on a cabinet",
        "none stated",
        "LakshyaTaneja/Metric-Semantic-3D-Reconstruction",
        "40979ab3bf2ef38496d7148758032b1647c51476",
        "data/images",
        "data/transforms.json",
    ),
    Recipe(
        "lockers",
        "room",
        "university room with lockers and tables",
        "none stated",
        "mamechun/gs_data",
        "57e50c56a1e601e468e012e0814187e5f698825b",
        "dense/0/images",
        "dense/0/sparse",
    ),
    Recipe(
        "desk",
        "room",
        "desk with two screens before a wall",
        "none stated",
        "Pradyumnak777/cv2-project-2",
        "a16030a4e454ae1c1f632cdf0798d28225f77a1f",
        "images",
        ESTIMATED,
        last=60,  # later the screens show something else
        focal="874",  # as in its sparse_text/cameras.txt
    ),
    Recipe(
        "fruit",
        "object",
        "apple and banana on quilted cloth",
        "none stated",
        "tusharparimi/fruit-NeRF",
        "236cb0105d687745f7a13f454679346a64ac47d6",
        "newfruit_small",
        "transforms.json",
    ),
    Recipe(
        "cup",
        "object",
        "coffee cup on a wooden desk",
        "none stated",
        "kwrous/final_tensorf",
        "85c25f19aecbf4b170a68e0fa93c19805b28de3b",
        "images",
        "sparse/0",
    ),
    Recipe(
        "figurine",
        "object",
        "stone figurine close up",
        "none stated",
        "bartoszek/test_colmap",
        "79fce7a67f15b0604e9741d9d50618840740b32f",
        "dense/0/images",
        "dense/0/sparse",
    ),
    Recipe(
        "can",
        "object",
        "drink can on tiles, railing",
        "none stated",
        "YhuoyuH/NeRF-Database",
        "83b34224ffb43e34e48db8137b3f95f8e7059cc3",
        "images",
        "sparse/0",
    ),
    Recipe(
        "fountain",
        "facade",
        "fountain-P11: relief before a brick wall",
        "none stated (Strecha et al.)",
        "ShengyuH/PySFM",
        "478dedcf42f7f1c88682be393f8f58a8d0b2a338",
        "matlab-code/data/images_50",
        ESTIMATED,
    ),
    Recipe(
        "rails",
        "outdoors",
        "rails on concrete slabs and tiles",
        "none stated",
        "wufake70/RailsDataSynthesis",
        "d8dd079350ed43f7a3bdfe4f32a9bbb79cecabf5",
        "rails/images",
        "rails/transforms.json",
    ),
    Recipe(
        "truck",
        "outdoors",
        "lorry in a street",
        "Tanks and Temples' own terms (non-commercial)",
        "tamochaman-nu/gaussian-splatting",
        "383ee4f4f1648134b2d41f3ce3eef980782c85db",
        "data/tandt/truck/images",
        ESTIMATED,
        first=42,
        last=136,  # once around it
        excluded=("000061.jpg",),  # a man before the lorry
        focal="580",  # half of that in its sparse/0/cameras.bin, which is of images twice as large
    ),
    Recipe(
        "plant",
        "vegetation",
        "potted plant on newspapers, living room",
        "none stated",
        "lvllvl/NeRF",
        "3b6aec04f821cc5686fc40174aebfed7d182fcb9",
        "data/raw",
        ESTIMATED,
        last=70,
    ),
    Recipe(
        "city",
        "aerial",
        "city with trees from a drone",
        "none stated",
        "Zeus-Xu/NeRF-3DGS",
        "30655651735acc321cbe9e9eb7560c7c9295a57a",
        "images",
        ESTIMATED,
        step=2,
        # A caption and a logo stand at the left of each frame. As much is cut off at its right, so that the optical
        # axis stays in the middle, where the estimation of cameras has it.
        crop=(200, 0, 760, 544),
    ),
)
