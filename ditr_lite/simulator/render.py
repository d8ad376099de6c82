"""Rendering with Mitsuba 3 (extra ``simulate``): from a scene description to images, depth and instance ids."""

from typing import Any

import numpy as np

from ..camera import Camera
from . import forms
from .scenes import PRISMS, VESSELS, Scene, Thing, cross_section, profile
from .stereo import dot_pattern
from .textures import environment, surrounding, texture

_CV_TO_MITSUBA = np.diag([-1.0, -1.0, 1.0, 1.0])  # our cameras: x right, y down; Mitsuba's: x left, y up
_SEGMENTS = 64  # of a full turn
PROJECTOR_DEG = 80.0  # field of view of the infrared projector
SLIDE_POWER, SLIDE_AMBIENT = 2.0, 0.03  # of a projector that shows a given picture
_FIRST = 4  # rays per pixel that tell the denoiser of the first surface
_SEEDS = 2**32  # that Mitsuba tells apart; a larger seed draws other scenes with the noise of a smaller one
_BLOCK = 32  # pixels a side that share a stream of random numbers; Mitsuba would choose by the number of threads


def mitsuba() -> Any:
    """Import Mitsuba 3 in its scalar variant, which needs neither a GPU nor LLVM.

    Raises:
        ImportError: when Mitsuba is not installed, saying how to install it.
    """
    try:
        import mitsuba as mi
    except ImportError:
        raise ImportError("rendering needs Mitsuba 3, an optional extra: pip install -e '.[simulate]'") from None
    if mi.variant() != "scalar_rgb":
        mi.set_variant("scalar_rgb")
        mi.set_log_level(mi.LogLevel.Error)
    return mi


def build_scene(
    scene: Scene,
    projector_pose: np.ndarray | None = None,
    rng: np.random.Generator | None = None,
    slide: np.ndarray | None = None,
) -> Any:
    """Build the Mitsuba scene: with room lights for the RGB view, or with a dot projector for the infrared views.

    Args:
        scene: what to build.
        projector_pose: (4, 4) world from projector; None for room light.
        rng: draws the dots, their strength and the ambient infrared light; needed with a projector.
        slide: (N, N) in [0, 1], what the projector shows instead of drawn dots; everything else is then fixed, too.
    """
    mi = mitsuba()
    infrared = projector_pose is not None
    parts: dict[str, Any] = {"type": "scene"}
    for i, thing in enumerate(scene.things):
        parts[f"thing_{i + 1}"] = _mesh(mi, f"thing_{i + 1}", thing, infrared)
    if infrared:
        pattern = dot_pattern(rng, share=rng.uniform(0.025, 0.06)) if slide is None else slide.astype(np.float32)
        dots = np.repeat(pattern[..., None], 3, axis=2)
        image = {"type": "bitmap", "bitmap": mi.Bitmap(dots), "raw": True, "filter_type": "bilinear"}
        pose = mi.ScalarTransform4f(projector_pose @ _CV_TO_MITSUBA)
        power, dusk = ((1.0, 2.5), (0.01, 0.25)) if scene.parts is None else ((1.5, 4.0), (0.004, 0.12))
        scale = float(rng.uniform(*power)) if slide is None else SLIDE_POWER
        beam = {"irradiance": image, "scale": scale, "fov": PROJECTOR_DEG}
        parts["projector"] = {"type": "projector", **beam, "to_world": pose}
        light = float(np.exp(rng.uniform(*np.log(dusk)))) if slide is None else SLIDE_AMBIENT
        parts["ambient"] = {"type": "constant", "radiance": light}
    else:
        around = scene.surrounding
        image = environment(scene.seed, scene.ambient) if around is None else surrounding(**around)
        parts["ambient"] = {"type": "envmap", "bitmap": mi.Bitmap(image)}
        if around is not None:  # z is up in our world, y in that of the map
            parts["ambient"]["to_world"] = mi.ScalarTransform4f().rotate([1, 0, 0], 90)
        for i, light in reversed(list(enumerate(scene.lights))):
            pose = mi.ScalarTransform4f().look_at(list(light["at"]), [0, 0, 0], [0, 1, 0.1]).scale(light["size"])
            emitter = {"type": "area", "radiance": {"type": "rgb", "value": light["power"].tolist()}}
            parts[f"light_{i}"] = {"type": "rectangle", "to_world": pose, "emitter": emitter}
    if scene.parts is not None:
        for i, part in enumerate(scene.parts):
            pose, bsdf = mi.ScalarTransform4f(part["pose"]), _opaque(mi, part, infrared)
            parts[f"part_{i}"] = {"type": part["shape"], "to_world": pose, "bsdf": bsdf}
        return mi.load_dict(parts, parallel=False, optimize=False)
    planes = [(scene.table, _plane((0, 0.15, 0), (1.1, 0.75), 0.0, upright=False))]
    planes.append(({**scene.table, "texture": "plain"}, _plane((0, 0, -0.75), (4, 4), 0.0, upright=False)))  # the floor
    planes += [(w, _plane((0, w["y"], 0), (3, 1.5), w["turn"], upright=True)) for w in scene.walls]
    for i, (look, pose) in reversed(list(enumerate(planes))):
        bsdf = _opaque(mi, look, infrared)
        parts[f"plane_{i}"] = {"type": "rectangle", "to_world": mi.ScalarTransform4f(pose), "bsdf": bsdf}
    return mi.load_dict(parts, parallel=False, optimize=False)  # else the order of the lamps is left to chance


def _plane(centre, half, turn: float, upright: bool) -> np.ndarray:
    c, s = np.cos(turn), np.sin(turn)
    pose = np.diag([half[0], half[1], 1.0, 1.0])
    if upright:  # stands on the line y = centre, turned about z, facing the camera
        pose = np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1.0]]) @ pose
    pose = np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]]) @ _move(centre) @ pose
    return pose


def _move(by) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, 3] = by
    return pose


def _opaque(mi, look: dict[str, Any], infrared: bool) -> dict[str, Any]:
    image = texture(look["texture"], look["colours"], look["texture_seed"])
    if infrared:  # inks differ less in infrared than in colour
        grey = image.mean(axis=2, keepdims=True)
        image = np.repeat(look["infrared"] * (0.75 + 0.25 * grey / max(grey.mean(), 1e-3)), 3, axis=2)
    bitmap = mi.Bitmap(np.clip(image, 0.01, 0.97).astype(np.float32))
    albedo = {"type": "bitmap", "bitmap": bitmap, "raw": True, "wrap_mode": "mirror"}
    if look.get("repeat", 1.0) != 1.0:
        albedo["to_uv"] = mi.ScalarTransform4f().scale(look["repeat"])
    if look["type"] == "plastic":
        bsdf = {"type": "roughplastic", "diffuse_reflectance": albedo, "alpha": look["roughness"]}
    else:
        bsdf = {"type": "diffuse", "reflectance": albedo}
    return {"type": "twosided", "bsdf": bsdf}


def _bsdf(mi, material: dict[str, Any], infrared: bool) -> dict[str, Any]:
    tint = {"type": "rgb", "value": list(material.get("tint", [1.0] * 3))}
    if infrared and "infrared" in material:
        tint = material["infrared"]  # share of infrared light that one wall lets through
    kind = material["type"]
    if infrared and kind == "glass" and material.get("seen_through"):
        kind = "thin_glass"
    match kind:
        case "thin_glass":
            return {"type": "thindielectric", "int_ior": material["ior"], "specular_transmittance": tint}
        case "glass":
            return {"type": "dielectric", "int_ior": material["ior"], "specular_transmittance": tint}
        case "mirror":
            return {"type": "twosided", "bsdf": {"type": "conductor", "material": material["metal"]}}
        case "brushed":
            alpha = material["roughness"]
            metal = {"type": "roughconductor", "material": material["metal"], "alpha": alpha}
            return {"type": "twosided", "bsdf": metal}
    return _opaque(mi, material, infrared)


def render(loaded: Any, camera: Camera, pose: np.ndarray, samples: int, seed: int, depth: int = 10) -> np.ndarray:
    """Return the (H, W, 3) float32 linear radiance that a camera sees; ``pose`` is (4, 4) world from camera.

    ``depth`` is the longest path, in segments.

    ``volpath`` rather than ``path``: its shadow rays pass straight through thin glass, so the dot pattern does too.
    """
    mi = mitsuba()
    integrator = mi.load_dict({"type": "volpath", "max_depth": depth, "rr_depth": 3, "block_size": _BLOCK})
    return _traced(loaded, integrator, camera, pose, samples, seed)[..., :3]


def render_clean(loaded: Any, camera: Camera, pose: np.ndarray, samples: int, seed: int, depth: int) -> np.ndarray:
    """Return what :func:`render` does, denoised by Intel Open Image Denoise with the first surfaces' colour and normal.

    Raises:
        ImportError: when the denoiser is not installed, saying how to install it.
    """
    mi = mitsuba()
    try:
        import pyoidn
    except ImportError:
        raise ImportError("room scenes need pyoidn, of an optional extra: pip install -e '.[simulate]'") from None
    # One after the other: both in one integrator take three times as long.
    colour = render(loaded, camera, pose, samples, seed, depth)
    integrator = mi.load_dict({"type": "aov", "aovs": "a:albedo,n:sh_normal", "block_size": _BLOCK})
    first = _traced(loaded, integrator, camera, pose, _FIRST, seed)
    albedo, normal = (np.ascontiguousarray(first[..., k : k + 3], np.float32) for k in (0, 3))
    bright = 60 * max(float(np.percentile(colour, 80)), 1e-6)  # single paths that met a lamp
    return pyoidn.denoise(
        np.clip(colour, 0, bright).astype(np.float32), albedo=np.clip(albedo, 0, 1), normal=normal, hdr=True
    )


def truth(loaded: Any, camera: Camera, pose: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the first surface that a camera sees through each pixel's centre.

    Of two surfaces that share a pixel it is the one that a random point of the pixel shows, carried on to the centre.

    Returns:
        (H, W, 3) float64 world points; (H, W) float32 depth in metres, 0 where nothing is hit; (H, W) int thing ids,
        0 for table, walls and floor, otherwise the position in ``scene.things`` plus 1.
    """
    mi = mitsuba()
    aovs = {"type": "aov", "aovs": "p:position,n:geo_normal,i:shape_index", "block_size": _BLOCK}
    image = _traced(loaded, mi.load_dict(aovs), camera, pose, 1, seed).astype(np.float64)
    point, normal, index = image[..., 0:3], image[..., 3:6], image[..., 6]
    # The one sample of a pixel is jittered: move it along the surface's tangent plane to the ray through the centre.
    v, u = np.mgrid[: camera.height, : camera.width]
    ray = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)
    ray = ray @ pose[:3, :3].T
    sampled = ((point - pose[:3, 3]) @ pose[:3, :3])[..., 2]
    slant = (ray * normal).sum(-1)
    depth = ((point - pose[:3, 3]) * normal).sum(-1) / np.where(np.abs(slant) < 0.05, np.inf, slant)
    depth = np.where(np.abs(depth - sampled) < 0.02 * sampled, depth, sampled)  # grazing surfaces keep the sample
    hit = np.linalg.norm(normal, axis=-1) > 0.5
    names = [shape.id() for shape in loaded.shapes()]
    ids = np.array([0] + [int(n.split("_")[1]) if n.startswith("thing_") else 0 for n in names])
    ids = ids[np.where(hit, np.rint(index), 0).astype(int)]  # Mitsuba counts shapes from 1; 0 is a miss
    depth = np.where(hit, depth, 0).astype(np.float32)
    return pose[:3, 3] + ray * depth[..., None], depth, ids


def _traced(loaded: Any, integrator: Any, camera: Camera, pose: np.ndarray, samples: int, seed: int) -> np.ndarray:
    sensor = _sensor(camera, pose, samples)
    return np.array(mitsuba().render(loaded, sensor=sensor, integrator=integrator, seed=seed % _SEEDS))


def _sensor(camera: Camera, pose: np.ndarray, samples: int):
    mi = mitsuba()
    film = {"type": "hdrfilm", "width": camera.width, "height": camera.height, "rfilter": {"type": "box"}}
    return mi.load_dict(
        {
            "type": "perspective",
            "fov": float(np.rad2deg(2 * np.arctan(camera.width / 2 / camera.fx))),
            "fov_axis": "x",
            "near_clip": 0.01,
            "far_clip": 50.0,
            "to_world": mi.ScalarTransform4f(pose @ _CV_TO_MITSUBA),
            "film": {**film, "pixel_format": "rgb", "component_format": "float32"},
            "sampler": {"type": "multijitter", "sample_count": samples},
        }
    )


def _mesh(mi, name: str, thing: Thing, infrared: bool):
    vertices, faces, uv = vertices_of(thing)
    vertices = (vertices * thing.scale) @ thing.pose[:3, :3].T + thing.pose[:3, 3]
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(_bsdf(mi, thing.material, infrared))
    smooth = thing.form is not None
    have = {"has_vertex_texcoords": True, "has_vertex_normals": smooth}
    mesh = mi.Mesh(name, len(vertices), len(faces), props=properties, **have)
    mesh.set_id(name)
    values = mi.traverse(mesh)
    values["vertex_positions"] = vertices.ravel().astype(np.float32)
    values["vertex_texcoords"] = uv.ravel().astype(np.float32)
    if smooth:
        values["vertex_normals"] = (
            forms.smooth_normals(vertices, faces, thing.form["segments"]).ravel().astype(np.float32)
        )
    values["faces"] = faces.ravel().astype(np.uint32)
    values.update()
    return mesh


def vertices_of(thing: Thing) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return vertices, faces and texture coordinates of a thing in its own frame, before scale and pose."""
    if thing.form is not None:
        return forms.mesh(thing.form)
    return triangles(thing.family, thing.material["type"] == "glass")


def triangles(family: str, solid: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return vertices (N, 3), faces (M, 3) and texture coordinates (N, 2) of a unit shape, normals pointing out.

    Args:
        family: a name of ``scenes``.
        solid: give a vessel a wall with an inside instead of a single sheet.
    """
    if family in VESSELS or family in ("sphere", "ellipsoid"):
        points = profile(family)
        if solid and family in VESSELS:
            points = forms.walled(points, 0.035)
        return forms.lathe(points, np.ones(_SEGMENTS + 1), repeats=2)
    if family in PRISMS:
        return _pulled(cross_section(family))
    return _pulled(np.array([(1, -1), (1, 1), (-1, 1), (-1, -1)], dtype=float))  # boxes, slabs, plates


def _pulled(section: np.ndarray) -> tuple[np.ndarray, ...]:
    """Pull a star-shaped outline (N, 2) from z = -1 to z = 1 and close it with fans about the axis."""
    n = len(section)
    ring = np.vstack([section, section[:1]])
    sides = np.concatenate([np.c_[ring, np.full(n + 1, -1.0)], np.c_[ring, np.full(n + 1, 1.0)]])
    along = np.linspace(0, 4, n + 1)
    uv = np.concatenate([np.c_[along, np.zeros(n + 1)], np.c_[along, np.ones(n + 1)]])
    i = np.arange(n)
    faces = [np.c_[i, i + 1, i + n + 2], np.c_[i, i + n + 2, i + n + 1]]
    for z in (-1.0, 1.0):
        base = len(sides)
        sides = np.concatenate([sides, np.c_[ring, np.full(n + 1, z)], [[0, 0, z]]])
        uv = np.concatenate([uv, (ring + 1) / 2, [[0.5, 0.5]]])
        fan = np.c_[base + i, base + i + 1, np.full(n, base + n + 1)]
        faces.append(fan if z > 0 else fan[:, ::-1])
    return sides, np.concatenate(faces), uv
