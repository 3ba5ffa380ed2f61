"""What may stand in a room: builders of small objects and the colours each one comes in."""

from collections.abc import Callable

from langsplat_core.datasets.synthetic import tableware, toys
from langsplat_core.datasets.synthetic.colours import COLOURS
from langsplat_core.datasets.synthetic.parts import Kit, Thing

Builder = Callable[[Kit, str], Thing]
BRIGHT = tuple(word for word in COLOURS if word not in ("gray", "beige", "brown", "black"))
# What may stand on the table, and the colours it comes in.
SMALL: dict[str, tuple[Builder, tuple[str, ...]]] = {
    "mug": (tableware.mug, COLOURS),
    "teapot": (tableware.teapot, COLOURS),
    "bottle": (tableware.bottle, ("green", "blue", "brown", "turquoise", "red", "purple", "white", "pink")),
    "bowl": (tableware.bowl, COLOURS),
    "plate": (tableware.plate, COLOURS),
    "vase": (tableware.vase, COLOURS),
    "plant": (tableware.plant, ("brown", "red", "white", "orange", "blue", "gray", "yellow", "purple")),
    "lamp": (tableware.lamp, BRIGHT),
    "book": (tableware.book, COLOURS),
    "clock": (tableware.clock, COLOURS),
    "orange": (toys.orange, ("orange",)),
    "apple": (toys.apple, ("red", "green", "yellow")),
    "banana": (toys.banana, ("yellow",)),
    "car": (toys.car, COLOURS),
    "block": (toys.block, COLOURS),
    "ball": (toys.toy_ball, COLOURS),
    "gift": (toys.gift, COLOURS),
    "duck": (toys.duck, ("yellow", "pink", "blue", "white", "green", "orange", "red", "purple")),
    "house": (toys.house, COLOURS),
    "robot": (toys.robot, COLOURS),
}
