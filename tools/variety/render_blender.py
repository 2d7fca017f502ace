"""A program of its own, run by a Python that has Blender's `bpy` (and none of tosslab): path-traced linear pictures.

    PYTHON render_blender.py JOB_FOLDER        # reads JOB_FOLDER/job.json, writes the pictures it names, in order
    VARIETY_BLENDER_DEVICE=CUDA PYTHON …       # on a graphics card: CUDA, OPTIX, HIP, METAL or ONEAPI

The job is plain data: bodies (`.npz` meshes, `.png` textures), lamps, a picture of the surroundings, one pinhole
camera, and pictures: a crop, samples a pixel, and where each moving body is at the begin and end of the shutter.
Every picture is a float16 array (rows from the top) in linear light.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import bpy  # type: ignore[import-not-found]
import numpy as np
from mathutils import Matrix  # type: ignore[import-not-found]

DEVICE = "VARIETY_BLENDER_DEVICE"
BOUNCES, DIFFUSE_BOUNCES, GLOSSY_BOUNCES = 4, 2, 2
SENSOR_MM = 36.0
CV_TO_BLENDER = np.diag([1.0, -1.0, -1.0, 1.0])


def main() -> int:
    folder = Path(sys.argv[1])
    job = json.loads((folder / "job.json").read_text())
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.context.preferences.edit.keyframe_new_interpolation_type = "LINEAR"
    scene = bpy.context.scene
    set_up(scene, job)
    camera(scene, job["camera"])
    bodies = {b["name"]: body(scene, folder, b) for b in job["bodies"]}
    for number, lamp in enumerate(job["lamps"]):
        light(scene, number, lamp)
    surroundings(scene, np.load(folder / "surroundings.npy"))
    moving = {b["name"]: bodies[b["name"]] for b in job["bodies"] if b["moving"]}
    for picture in job["pictures"]:
        render(scene, folder, job, moving, picture)
        print(f"done {picture['out']}", flush=True)
    return 0


def set_up(scene, job) -> None:  # type: ignore[no-untyped-def]
    scene.render.engine = "CYCLES"
    cycles = scene.cycles
    cycles.device, cycles.use_adaptive_sampling, cycles.seed = "CPU", False, int(job["seed"]) % (1 << 31)
    if DEVICE in os.environ:
        on_graphics_card(cycles, os.environ[DEVICE])
    cycles.use_denoising, cycles.denoiser, cycles.denoising_prefilter = True, "OPENIMAGEDENOISE", "FAST"
    cycles.max_bounces, cycles.diffuse_bounces, cycles.glossy_bounces = BOUNCES, DIFFUSE_BOUNCES, GLOSSY_BOUNCES
    cycles.caustics_reflective = cycles.caustics_refractive = False
    scene.render.threads_mode, scene.render.threads = "FIXED", int(job["threads"])
    scene.render.use_persistent_data = True
    scene.render.image_settings.file_format = "OPEN_EXR"
    scene.render.image_settings.color_depth, scene.render.image_settings.exr_codec = "16", "NONE"
    scene.render.motion_blur_position, scene.render.motion_blur_shutter = "START", 1.0
    rolling = job["exposure_s"] / (job["exposure_s"] + job["readout_s"])
    if job["readout_s"] > 0:
        cycles.rolling_shutter_type, cycles.rolling_shutter_duration = "TOP", rolling


def on_graphics_card(cycles, kind) -> None:  # type: ignore[no-untyped-def]
    settings = bpy.context.preferences.addons["cycles"].preferences
    try:
        settings.compute_device_type = kind
    except TypeError as wrong:
        raise SystemExit(f"{DEVICE}={kind}: {wrong}") from wrong
    settings.get_devices()
    for device in settings.devices:
        device.use = device.type == kind
    if not any(d.use for d in settings.devices):
        raise SystemExit(f"{DEVICE}={kind}: Blender sees no such graphics card; unset it to render on the processor")
    cycles.device, cycles.denoising_use_gpu = "GPU", True


def camera(scene, told) -> None:  # type: ignore[no-untyped-def]
    scene.render.resolution_x, scene.render.resolution_y = told["width"], told["height"]
    scene.render.resolution_percentage = 100
    data = bpy.data.cameras.new("camera")
    data.sensor_fit, data.sensor_width = "HORIZONTAL", SENSOR_MM
    data.lens = told["focal_px"] * SENSOR_MM / told["width"]
    data.shift_x = (told["width"] / 2 - told["cx"] - 0.5) / told["width"]
    data.shift_y = (told["cy"] + 0.5 - told["height"] / 2) / told["width"]
    data.clip_start, data.clip_end = 0.02, 50.0
    found = bpy.data.objects.new("camera", data)
    found.matrix_world = Matrix((np.array(told["world_from_camera"]) @ CV_TO_BLENDER).tolist())
    scene.collection.objects.link(found)
    scene.camera = found


def body(scene, folder, told):  # type: ignore[no-untyped-def]
    stored = np.load(folder / told["mesh"])
    mesh = bpy.data.meshes.new(told["name"])
    faces = stored["faces"]
    mesh.from_pydata(stored["vertices"].tolist(), [], faces.tolist())
    mesh.uv_layers.new(name="uv").data.foreach_set("uv", stored["uv"].reshape(-1))
    mesh.polygons.foreach_set("use_smooth", np.ones(len(faces), bool))
    if len(mesh.loops) == stored["normals"].size // 3:
        mesh.normals_split_custom_set(stored["normals"].reshape(-1, 3).tolist())
    mesh.materials.append(material(folder, told))
    found = bpy.data.objects.new(told["name"], mesh)
    found.rotation_mode = "QUATERNION"
    scene.collection.objects.link(found)
    return found


def material(folder, told):  # type: ignore[no-untyped-def]
    found = bpy.data.materials.new(told["name"])
    found.use_nodes = True
    nodes, links = found.node_tree.nodes, found.node_tree.links
    surface = nodes["Principled BSDF"]
    surface.inputs["Roughness"].default_value = told["roughness"]
    surface.inputs["Metallic"].default_value = told["metallic"]
    surface.inputs["Coat Weight"].default_value = told["coat"]
    surface.inputs["Coat Roughness"].default_value = 0.05
    picture = nodes.new("ShaderNodeTexImage")
    picture.image, picture.extension = bpy.data.images.load(str(folder / told["texture"])), "EXTEND"
    links.new(picture.outputs["Color"], surface.inputs["Base Color"])
    return found


def light(scene, number, told) -> None:  # type: ignore[no-untyped-def]
    data = bpy.data.lights.new(f"lamp{number}", "AREA")
    data.energy, data.size, data.color = told["power_w"], told["size_m"], told["rgb"]
    found = bpy.data.objects.new(f"lamp{number}", data)
    at = np.array(told["position_m"])
    away = at / np.linalg.norm(at)
    side = np.cross([0.0, 1.0, 0.0] if abs(away[1]) < 0.9 else [1.0, 0.0, 0.0], away)
    side /= np.linalg.norm(side)
    place = np.eye(4)
    place[:3, :3], place[:3, 3] = np.stack([side, np.cross(away, side), away], 1), at
    found.matrix_world = Matrix(place.tolist())
    scene.collection.objects.link(found)


def surroundings(scene, picture) -> None:  # type: ignore[no-untyped-def]
    height, width = picture.shape[:2]
    image = bpy.data.images.new("surroundings", width, height, float_buffer=True)
    full = np.ones((height, width, 4), np.float32)
    full[..., :3] = picture[::-1]
    image.pixels.foreach_set(full.reshape(-1))
    world = bpy.data.worlds.new("world")
    scene.world, world.use_nodes = world, True
    node = world.node_tree.nodes.new("ShaderNodeTexEnvironment")
    node.image = image
    world.node_tree.links.new(node.outputs["Color"], world.node_tree.nodes["Background"].inputs["Color"])


def render(scene, folder, job, moving, told) -> None:  # type: ignore[no-untyped-def]
    blurred = False
    for name, found in moving.items():
        found.hide_render = name not in told["at"]
        found.animation_data_clear()
        if name in told["at"]:
            begin, end = (Matrix(m) for m in told["at"][name])
            blurred |= put(found, begin, end)
    scene.render.use_motion_blur = blurred
    scene.frame_set(0)
    x0, y0, x1, y1 = told["crop"]
    width, height = job["camera"]["width"], job["camera"]["height"]
    scene.render.use_border = scene.render.use_crop_to_border = True
    scene.render.border_min_x, scene.render.border_max_x = (x0 + 0.02) / width, (x1 + 0.02) / width
    scene.render.border_min_y, scene.render.border_max_y = 1 - (y1 - 0.02) / height, 1 - (y0 - 0.02) / height
    scene.cycles.samples = told["samples"]
    path = folder / "picture.exr"
    scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)
    np.save(folder / told["out"], pixels(path, (y1 - y0, x1 - x0)))


def put(found, begin, end) -> bool:  # type: ignore[no-untyped-def]
    """The body at both ends of the shutter; whether it moves in between."""
    found.location, found.rotation_quaternion = begin.to_translation(), begin.to_quaternion()
    later = end.to_quaternion()
    if later.dot(found.rotation_quaternion) < 0:
        later.negate()
    shift = (end.to_translation() - begin.to_translation()).length
    if shift < 2e-5 and abs(later.dot(found.rotation_quaternion)) > 1 - 1e-9:
        return False
    found.keyframe_insert("location", frame=0)
    found.keyframe_insert("rotation_quaternion", frame=0)
    found.location, found.rotation_quaternion = end.to_translation(), later
    found.keyframe_insert("location", frame=1)
    found.keyframe_insert("rotation_quaternion", frame=1)
    return True


def pixels(path, shape):  # type: ignore[no-untyped-def]
    image = bpy.data.images.load(str(path), check_existing=False)
    width, height = image.size
    if (height, width) != shape:
        raise SystemExit(f"Blender rendered {width}x{height} px, wanted {shape[1]}x{shape[0]}")
    flat = np.empty(width * height * 4, np.float32)
    image.pixels.foreach_get(flat)
    bpy.data.images.remove(image)
    return np.clip(flat.reshape(height, width, 4)[::-1, :, :3], 0, 6e4).astype(np.float16)


if __name__ == "__main__":
    sys.exit(main())
