"""The captures to choose frames from: repositories, commits, folders of images, and cameras."""

from dataclasses import dataclass

from .capture import CaptureSource

ESTIMATED = "estimated"


@dataclass(frozen=True)
class Recipe(CaptureSource):
    """How to make a capture of its images.

    cameras: a path in the repository, or ESTIMATED. first, last, step: the slice of the folder's images, in order.
    focal: focal length for estimated cameras, as `idesplat cameras estimate` takes it.
    """

    cameras: str
    first: int = 0
    last: int | None = None
    step: int = 1
    focal: str | None = None


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
        step=3,
    ),
)
