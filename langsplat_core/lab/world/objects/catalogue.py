"""The vocabulary of things: builders of every class and the colours each one comes in."""

from collections.abc import Callable

from langsplat_core.lab.world.appearance.colours import COLOURS
from langsplat_core.lab.world.objects import (
    animals,
    clothes,
    food,
    furniture,
    places,
    tableware,
    tools,
    toys,
    utensils,
    vehicles,
)
from langsplat_core.lab.world.objects.kit import Kit, Thing

Builder = Callable[[Kit, str], Thing]
BRIGHT = tuple(word for word in COLOURS if word not in ("gray", "beige", "brown", "black"))
_FUR = ("brown", "beige", "white", "gray", "pink", "blue", "purple")
_WOOD = ("brown", "beige", "white", "red", "blue", "green", "yellow", "gray")
_METAL = ("gray", "black", "red", "blue", "green", "turquoise", "white")
# Everything that is small enough for a table.
TABLE_TOP: dict[str, tuple[Builder, tuple[str, ...]]] = {
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
    "orange": (food.orange, ("orange",)),
    "apple": (food.apple, ("red", "green", "yellow")),
    "banana": (food.banana, ("yellow",)),
    "car": (toys.car, COLOURS),
    "block": (toys.block, COLOURS),
    "ball": (toys.toy_ball, COLOURS),
    "gift": (toys.gift, COLOURS),
    "duck": (animals.duck, ("yellow", "pink", "blue", "white", "green", "orange", "red", "purple")),
    "house": (toys.house, COLOURS),
    "robot": (toys.robot, COLOURS),
    "candle": (utensils.candle, (*BRIGHT, "beige")),
    "pan": (utensils.pan, ("black", "gray", "red", "blue", "turquoise", "green", "orange")),
    "wine glass": (
        utensils.goblet,
        ("white", "green", "blue", "turquoise", "red", "purple", "pink", "yellow"),
    ),
    "basket": (utensils.basket, BRIGHT),
    "carrot": (food.carrot, ("orange",)),
    "cake": (food.cake, ("pink", "white", "brown", "yellow", "green", "turquoise", "purple")),
    "donut": (food.donut, ("pink", "brown", "white", "turquoise", "yellow", "purple", "green")),
    "ice cream": (food.ice_cream, ("pink", "white", "brown", "green", "yellow", "turquoise", "purple")),
    "burger": (food.burger, ("brown",)),
    "train": (vehicles.train, COLOURS),
    "truck": (vehicles.truck, COLOURS),
    "airplane": (vehicles.airplane, COLOURS),
    "boat": (vehicles.boat, COLOURS),
    "rocket": (vehicles.rocket, COLOURS),
    "teddy bear": (animals.teddy_bear, _FUR),
    "rabbit": (animals.rabbit, ("white", "brown", "gray", "beige", "pink", "blue")),
    "penguin": (animals.penguin, ("black", "blue", "gray", "purple", "turquoise", "green")),
    "fish": (animals.fish, (*BRIGHT, "gray")),
    "snail": (animals.snail, COLOURS),
    "scissors": (tools.scissors, COLOURS),
    "umbrella": (tools.umbrella, COLOURS),
    "camera": (tools.camera, COLOURS),
    "laptop": (tools.laptop, _METAL),
    "headphones": (tools.headphones, COLOURS),
    "globe": (tools.globe, ("blue", "turquoise", "purple", "gray", "black", "pink")),
    "guitar": (tools.guitar, COLOURS),
    "drum": (tools.drum, COLOURS),
    "hat": (clothes.hat, COLOURS),
    "shoe": (clothes.shoe, COLOURS),
    "backpack": (clothes.backpack, COLOURS),
    "snowman": (places.snowman, (*BRIGHT, "black")),
    "windmill": (places.windmill, COLOURS),
    "castle": (places.castle, ("gray", "beige", "brown", "pink", "white", "orange", "yellow", "purple")),
    "cactus": (places.cactus, (*BRIGHT, "brown")),
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
