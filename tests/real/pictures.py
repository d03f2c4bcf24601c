"""Pictures that were once missed or read wrongly, each with its tags, at every smallest size that is asked for."""

from photographs import middle, near
from program import Figure

SIZES = (8, 12, 16, 24)
# File, how it is asked for, tags and where their middles are (`None`: anywhere).
PICTURES = [
    ("haze_white250_black190.png", (), {7: None}),
    ("fills_frame_233_of_240.png", (), {7: None}),
    ("tilt80.png", (), {7: None}),
    ("bloom_43px.png", (), {8: None}),
    ("dim_41h12_white40.png", ("--family", "41h12"), {0: None}),
    ("border2_crop.png", ("--border", "2"), {7: (168.8, 44.2)}),
    ("border1_squares_picture4.png", (), {34: (756.5, 254.2)}),
    ("frame_ok.jpg", (), {1: (632.6, 599.7), 0: (694.6, 691.5)}),
]
KALIBR = "border1_squares_picture4.png"


def figures(program, folder):
    wanted = found = 0
    sheet = []
    for name, options, tags in PICTURES:
        for px in SIZES:
            (line,) = program.json_lines("detect", folder / name, "--min-px", px, *options)
            seen = line["detections"]
            wanted += len(tags)
            found += sum(any(is_tag(d, number, at) for d in seen) for number, at in tags.items())
            if name == KALIBR:
                sheet.append(len(seen))
    yield Figure(f"of {wanted} tags in pictures that were once missed, found", found, least=wanted)
    yield Figure("tags of a sheet of 36 with Kalibr's squares, at the worst size", min(sheet), least=36)
    (line,) = program.json_lines("detect", folder / "border2_crop.png", "--min-px", 12)
    yield Figure("tags with a border of two cells taken for one of one", len(line["detections"]), most=0)
    # The same places in both: an interval of the second is lost elsewhere.
    whole, cut = (
        {d["id"] for d in program.json_lines("detect", folder / f"rst_{name}.jpg")[0]["detections"]}
        for name in ("ok", "one_interval_lost")
    )
    yield Figure("tags of a picture that a lost interval hides", len(whole - cut), most=0)


def is_tag(found, number, at):
    return found["id"] == number and (at is None or near(middle(found["corners"]), at, 1.0))
