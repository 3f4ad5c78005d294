"""From nothing to a textured object under an HDRI, and to a medium fitted to images.

Each step is a page and lines of it, in the order in which an artist meets them: a command, Python, or files to save.
"""

STEPS = [
    # a first picture of the kind
    ("docs/start.md", "ball.xml"),
    ("docs/start.md", "halfspace-sss render ball.xml --model neural --spp 64"),
    # a medium from a colour and a radius, kept as a material
    ("docs/materials.md", """
import halfspace_sss as sss
skin = sss.Medium.from_reflectance([0.72, 0.48, 0.38], mfp=[1.2, 0.4, 0.2], g=0.8, eta=1.4)
sss.materials.write("mine.toml", sss.materials.Material("my skin", skin, channels=("R", "G", "B")))
print(sss.materials.register("mine.toml"), sss.materials.load("my skin").medium)  # the same with all digits
"""),
    # a mesh with a texture under an HDRI
    ("docs/rendering.md", "toy.xml"),
    ("docs/rendering.md", "halfspace-sss render toy.xml --model path_traced --denoise --spp 64"),
    # images of an object, and its medium from them
    ("docs/inverse.md", "scene.xml truth.xml views.json"),
    ("docs/inverse.md", "halfspace-sss render truth.xml --model path_traced --spp 512 --sensor 0,1 --out ."),
    ("docs/inverse.md",
     "halfspace-sss fit scene.xml --images views.json --parameter albedo,sigma_t --work work --out fit"),
    ("docs/inverse.md", "halfspace-sss render fit/scene_fit.xml --model path_traced --spp 256 --out fit"),
]  # fmt: skip
