"""The vocabulary of things: builders of every class and the colours each one comes in."""

from collections.abc import Callable

from assets.making.kit import COLOURS, Kit, Thing
from assets.making.objects import belongings, furniture, kitchen, toys

Builder = Callable[[Kit, str], Thing]
BRIGHT = tuple(word for word in COLOURS if word not in ("gray", "beige", "brown", "black"))
_FUR = ("brown", "beige", "white", "gray", "pink", "blue", "purple")
_WOOD = ("brown", "beige", "white", "red", "blue", "green", "yellow", "gray")
_METAL = ("gray", "black", "red", "blue", "green", "turquoise", "white")
# Everything that is small enough for a table.
TABLE_TOP: dict[str, tuple[Builder, tuple[str, ...]]] = {
    "mug": (kitchen.mug, COLOURS),
    "teapot": (kitchen.teapot, COLOURS),
    "bottle": (kitchen.bottle, ("green", "blue", "brown", "turquoise", "red", "purple", "white", "pink")),
    "bowl": (kitchen.bowl, COLOURS),
    "plate": (kitchen.plate, COLOURS),
    "vase": (kitchen.vase, COLOURS),
    "plant": (kitchen.plant, ("brown", "red", "white", "orange", "blue", "gray", "yellow", "purple")),
    "lamp": (kitchen.lamp, BRIGHT),
    "book": (kitchen.book, COLOURS),
    "clock": (kitchen.clock, COLOURS),
    "orange": (kitchen.orange, ("orange",)),
    "apple": (kitchen.apple, ("red", "green", "yellow")),
    "banana": (kitchen.banana, ("yellow",)),
    "car": (toys.car, COLOURS),
    "block": (toys.block, COLOURS),
    "ball": (toys.toy_ball, COLOURS),
    "gift": (toys.gift, COLOURS),
    "duck": (toys.duck, ("yellow", "pink", "blue", "white", "green", "orange", "red", "purple")),
    "house": (toys.house, COLOURS),
    "robot": (toys.robot, COLOURS),
    "candle": (kitchen.candle, (*BRIGHT, "beige")),
    "pan": (kitchen.pan, ("black", "gray", "red", "blue", "turquoise", "green", "orange")),
    "wine glass": (
        kitchen.goblet,
        ("white", "green", "blue", "turquoise", "red", "purple", "pink", "yellow"),
    ),
    "basket": (kitchen.basket, BRIGHT),
    "carrot": (kitchen.carrot, ("orange",)),
    "cake": (kitchen.cake, ("pink", "white", "brown", "yellow", "green", "turquoise", "purple")),
    "donut": (kitchen.donut, ("pink", "brown", "white", "turquoise", "yellow", "purple", "green")),
    "ice cream": (kitchen.ice_cream, ("pink", "white", "brown", "green", "yellow", "turquoise", "purple")),
    "burger": (kitchen.burger, ("brown",)),
    "train": (toys.train, COLOURS),
    "truck": (toys.truck, COLOURS),
    "airplane": (toys.airplane, COLOURS),
    "boat": (toys.boat, COLOURS),
    "rocket": (toys.rocket, COLOURS),
    "teddy bear": (toys.teddy_bear, _FUR),
    "rabbit": (toys.rabbit, ("white", "brown", "gray", "beige", "pink", "blue")),
    "penguin": (toys.penguin, ("black", "blue", "gray", "purple", "turquoise", "green")),
    "fish": (toys.fish, (*BRIGHT, "gray")),
    "snail": (toys.snail, COLOURS),
    "scissors": (belongings.scissors, COLOURS),
    "umbrella": (belongings.umbrella, COLOURS),
    "camera": (belongings.camera, COLOURS),
    "laptop": (belongings.laptop, _METAL),
    "headphones": (belongings.headphones, COLOURS),
    "globe": (belongings.globe, ("blue", "turquoise", "purple", "gray", "black", "pink")),
    "guitar": (belongings.guitar, COLOURS),
    "drum": (belongings.drum, COLOURS),
    "hat": (belongings.hat, COLOURS),
    "shoe": (belongings.shoe, COLOURS),
    "backpack": (belongings.backpack, COLOURS),
    "snowman": (belongings.snowman, (*BRIGHT, "black")),
    "windmill": (belongings.windmill, COLOURS),
    "castle": (belongings.castle, ("gray", "beige", "brown", "pink", "white", "orange", "yellow", "purple")),
    "cactus": (belongings.cactus, (*BRIGHT, "brown")),
}
# Life-size, standing on the floor; pictures hang on walls.
FURNITURE: dict[str, tuple[Builder, tuple[str, ...]]] = {
    "table": (furniture.table, ("brown", "beige")),
    "chair": (furniture.chair, BRIGHT),
    "stool": (furniture.stool, BRIGHT),
    "sofa": (furniture.sofa, COLOURS),
    "bed": (furniture.bed, COLOURS),
    "shelf": (furniture.shelf, _WOOD),
    "cabinet": (furniture.cabinet, _WOOD),
    "picture": (furniture.picture, ("brown", "black", "white")),
}
EVERYTHING = {**TABLE_TOP, **FURNITURE}
