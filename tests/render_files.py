"""Small scene files for the tests of the command `render`."""

from __future__ import annotations

import sys

START = [sys.executable, "-c", "from figures.command_line import main; main()"]
XML = """<scene version="3.0.0">
  <integrator type="bssrdf"><integer name="max_depth" value="3"/></integrator>
  <emitter type="constant"/>
  <shape type="sphere"><float name="radius" value="5"/>
    <bsdf type="translucent"><string name="material" value="marble"/><string name="model" value="better_dipole"/></bsdf>
  </shape>
  <shape type="rectangle"><transform name="to_world"><scale value="9"/><translate z="-7"/></transform>
    <bsdf type="diffuse"><texture type="checkerboard" name="reflectance"/></bsdf>
  </shape>
  <sensor type="perspective"><float name="fov" value="20"/>
    <transform name="to_world"><lookat origin="0,0,40" target="0,0,0" up="0,1,0"/></transform>
    <film type="hdrfilm"><integer name="width" value="16"/><integer name="height" value="16"/></film>
  </sensor>
</scene>
"""
SENSOR = XML[XML.index("  <sensor") : XML.index("</scene>")]
INTEGRATOR = '<integrator type="bssrdf"><integer name="max_depth" value="3"/></integrator>'
TWO_SURFACES = '<bsdf type="dielectric"/><bsdf type="diffuse"/>'

BAD_SCENES = {  # what is wrong -> what stands there instead of what, and the message
    "material": ("marble", "marbel", "(line 5, col 6): material must be one of the 48 registered, got 'marbel'; did"),
    "model": ("better_dipole", "beter_dipole", "did you mean 'better_dipole'?"),
    "plugin": ('"diffuse"', '"difuse"', '"difuse" not found'),
    "parameter": ('name="radius"', 'name="radus"', "radus"),
    "type": ('<float name="radius"', '<string name="radius"', 'property "radius" has the wrong type'),
    "mesh": ('type="rectangle">', 'type="obj"><string name="filename" value="no.obj"/>', '"no.obj": file not found'),
    "sky": ('type="constant"/>', 'type="envmap"><string name="filename" value="no.exr"/></emitter>', "no.exr"),
    "unit": (INTEGRATOR, INTEGRATOR.replace("integer", "float").replace("max_depth", "mm_per_unit")
             .replace("3", "0"), "mm_per_unit must be a number in [1e-09, 1e+09], got 0.0"),
    "depth": ('name="max_depth" value="3"', 'name="max_depth" value="0"', "max_depth must be -1 or a whole number >="),
    "film": ('name="width" value="16"', 'name="width" value="0"', "a film must have 1 to 67108864 pixels, got 0 x 16"),
    "sensor": (SENSOR, "", "the scene must have a sensor, got none"),
    "boundary": ('<string name="material"', TWO_SURFACES + '<string name="material"', "at most one BSDF inside, got 2"),
    "surface": ('type="translucent"', 'type="plastic"', "translucent BSDF"),
    "parameter of a scene": ('value="5"', 'value="$size"', "size"),
    "end": ("</scene>", "", "cannot be read"),
}  # fmt: skip
