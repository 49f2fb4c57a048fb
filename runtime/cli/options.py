"""Options that several commands have, each with one meaning and one help text."""

from pathlib import Path
from typing import Annotated

import typer

from ..cameras.formats import CameraFormat
from ..reconstruction.quality import Quality
from ..views.exposure_mode import ExposureMode
from .config_file import read_config


def parse_count(text: str | int) -> int:
    """A whole number; typer itself reads 0-1 as -1."""
    try:
        return int(text)
    except ValueError:
        raise typer.BadParameter(f"{text} is no whole number") from None


IMAGES_HELP = "Folder, glob or files of images, or a video."
CAMERAS_HELP = (
    "File or folder of cameras: transforms.json, COLMAP, RealEstate10K, LLFF, DTU, OpenCV stereo, our own JSON."
)

Images = Annotated[list[Path] | None, typer.Option("--images", "-i", help=IMAGES_HELP, show_default=False)]
# `--images a.png b.png`, as a shell expands a glob
MoreImages = Annotated[list[Path] | None, typer.Argument(hidden=True)]
Cameras = Annotated[
    Path | None,
    typer.Option(
        "--cameras",
        "-c",
        help=CAMERAS_HELP,
        show_default=False,
    ),
]
CamerasFormat = Annotated[
    CameraFormat | None, typer.Option(help="Format of the cameras, where their content does not tell it.")
]
Focal = Annotated[
    str | None,
    typer.Option(help="For estimated cameras: focal length in pixels, or on 35 mm film such as 26mm."),
]
Model = Annotated[
    Path | None,
    typer.Option(
        "--model",
        "-m",
        help="A .onnx file or staged folder made by `idesplat export`, or a name that `idesplat models` lists; else "
        "the bundled model.",
        metavar="PATH|NAME",
    ),
]
EXECUTION = "Where the model runs"
MAX_THREADS = 1024
PROVIDER = typer.Option(
    help="Execution provider of ONNX Runtime (`idesplat bench --list-providers`), or auto: a GPU where one works, "
    "else the CPU.",
    metavar="auto|NAME",
    rich_help_panel=EXECUTION,
)
Provider = Annotated[str, PROVIDER]
# One or several, to compare them.
Providers = Annotated[list[str] | None, PROVIDER]
ProviderOption = Annotated[
    list[str] | None,
    typer.Option(
        help="Option of the provider, as its documentation names it; may be repeated.",
        metavar="NAME=VALUE",
        show_default=False,
        rich_help_panel=EXECUTION,
    ),
]
Device = Annotated[
    str | None,
    typer.Option(
        help="Device of the provider: its number, or its type.",
        metavar="N|cpu|gpu|npu",
        show_default=False,
        rich_help_panel=EXECUTION,
    ),
]
Threads = Annotated[
    int | None,
    typer.Option(
        help="CPU threads of the model, instead of one for each core.",
        min=1,
        max=MAX_THREADS,
        rich_help_panel=EXECUTION,
    ),
]
Size = Annotated[
    str | None,
    typer.Option(help="HEIGHTxWIDTH to work at, such as 256x448; else the trained size.", show_default=False),
]
Near = Annotated[float | None, typer.Option(help="Nearest depth in scene units; found where not given.")]
Far = Annotated[float | None, typer.Option(help="Farthest depth in scene units; found where not given.")]
Json = Annotated[Path | None, typer.Option("--json", help="Write a summary as JSON, to standard output if it is -.")]
Overwrite = Annotated[
    bool, typer.Option("--overwrite", help="Replace existing files that idesplat did not write, too; never inputs.")
]
Host = Annotated[str, typer.Option(help="Address to serve at; other machines do not see the default.")]
Port = Annotated[int, typer.Option(help="Port to serve at, 0 for any.", min=0, max=65535)]

GENERAL = "Every command"
Config = Annotated[
    Path | None,
    typer.Option(
        "--config",
        help="TOML file with options of this command by their names, such as `max-depth-jump = 0.05`; the command line "
        "goes before it.",
        callback=read_config,
        is_eager=True,
        rich_help_panel=GENERAL,
    ),
]
Verbose = Annotated[
    int,
    typer.Option(
        "--verbose",
        "-v",
        count=True,
        help="Log to stderr what is done; twice: in detail.",
        show_default=False,
        rich_help_panel=GENERAL,
    ),
]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Show neither progress nor notes.", rich_help_panel=GENERAL)]

MaxGaussians = Annotated[
    int, typer.Option(help="Keep at most so many Gaussians, those that contribute most to the images; 0: all.", min=0)
]
QualityOption = Annotated[
    Quality | None,
    typer.Option(
        "--quality",
        help="fast: two images, as the network predicts them. standard: eight, fused and refined. high: 24, larger, "
        "with more steps. Else standard, and fast with --model.",
        show_default=False,
    ),
]
Refine = Annotated[
    str | None,
    typer.Option(
        help="Steps of refinement on the images, one image each, or its time such as 30s; 0 for none. Else as "
        "--quality says.",
        metavar="N|SECONDSs",
    ),
]
Views = Annotated[
    str | None,
    typer.Option(
        help="How many images to use, those with the best baselines; else as --quality says, or all of --select.",
        metavar="N|all",
    ),
]
Select = Annotated[
    str | None, typer.Option(help="Images to use: names, numbers from 0, 0-3 or 0:8:2, with commas between.")
]
Crop = Annotated[bool, typer.Option("--crop", help="Use the middle of the images at the model's trained size.")]
Offset = Annotated[
    str | None,
    typer.Option(
        help="Write coordinates relative to this, where they are large (surveys): `auto` finds it if it is needed.",
        metavar="auto|X,Y,Z",
    ),
]
Exposure = Annotated[
    ExposureMode,
    typer.Option(help="Bring images of differing exposure and white balance to a common one, or leave them."),
]

FILTERS = "Filters (off unless asked for)"
MinOpacity = Annotated[
    float, typer.Option(help="Leave out Gaussians of lower opacity, 0 to 1.", rich_help_panel=FILTERS)
]
CropBorder = Annotated[
    int, typer.Option(help="Leave out this many pixels along every image's edges.", rich_help_panel=FILTERS)
]
DepthJump = Annotated[
    float,
    typer.Option(
        help="Leave out pixels whose depth differs from a neighbour's by more than this share, such as 0.05.",
        rich_help_panel=FILTERS,
    ),
]
MinConsistency = Annotated[
    float,
    typer.Option(
        help="Leave out pixels whose depth a smaller share of the other views confirms, such as 0.5.",
        rich_help_panel=FILTERS,
    ),
]
RemoveContradicted = Annotated[
    bool,
    typer.Option(
        "--remove-contradicted",
        help="Leave out what other views see through, with three views or more (--quality standard and high do).",
        rich_help_panel=FILTERS,
    ),
]
MergeDuplicates = Annotated[
    bool,
    typer.Option(
        "--merge-duplicates",
        help="Make one Gaussian of those that views put at the same place.",
        rich_help_panel=FILTERS,
    ),
]
CloseHoles = Annotated[
    bool,
    typer.Option(
        "--close-holes",
        help="Fit the Gaussians' shapes to the surface, and add background behind edges and beyond the frames "
        "(--quality standard and high do).",
        rich_help_panel=FILTERS,
    ),
]
