import numpy as np
import pytest

from processing.contact.physics.geometry import CORNERS, hull_mesh
from processing.contact.report.assets import write_assets
from recordings.tracks import ContactModel, ObjectShape

HALF_M = np.array([0.05, 0.04, 0.03])
INERTIA = np.diag([0.0003, 0.0004, 0.0005]) + 1e-5 * (np.ones((3, 3)) - np.eye(3))
CENTER_M = np.array([0.002, 0.0, 0.001])


@pytest.fixture(params=["one piece", "two pieces"])
def assets(request, tmp_path):
    points, pieces = CORNERS * HALF_M, (tuple(range(8)),)
    if request.param == "two pieces":
        points = np.concatenate([points * [0.5, 1, 1] - [0.025, 0, 0], points * [0.5, 1, 1] + [0.025, 0, 0]])
        pieces = (tuple(range(8)), tuple(range(8, 16)))
    model = ContactModel(
        "object", points, pieces, 0.18, 0.16, 0.2, 0.37, INERTIA, CENTER_M, "test", np.array([0, 0, 1.0]), 0.0
    )
    return write_assets(tmp_path, model, ObjectShape("object", "contact", *hull_mesh(points)))


def test_mujoco_loads_it_and_it_rests_on_a_plane(assets):
    import mujoco

    spec = mujoco.MjSpec.from_file(str(assets["mjcf"]))
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[1, 1, 0.1], friction=[1, 0.005, 0.0001])
    model = spec.compile()
    body = model.body("object")
    assert model.body_mass[body.id] == pytest.approx(0.37)
    np.testing.assert_allclose(np.sort(model.body_inertia[body.id]), np.linalg.eigvalsh(INERTIA), rtol=1e-6)
    data = mujoco.MjData(model)
    data.qpos[2] = 0.06
    for _ in range(1000):
        mujoco.mj_step(model, data)
    assert data.qpos[2] == pytest.approx(HALF_M[2], abs=0.002)
    assert {c.friction[0] for c in data.contact} == {0.18}


def test_pybullet_loads_it_and_it_rests_on_a_plane(assets):
    pybullet = pytest.importorskip("pybullet", reason="extra `sim`")
    client = pybullet.connect(pybullet.DIRECT)
    try:
        shape = pybullet.createCollisionShape(pybullet.GEOM_PLANE, physicsClientId=client)
        ground = pybullet.createMultiBody(0, shape, physicsClientId=client)
        pybullet.changeDynamics(ground, -1, lateralFriction=1.0, physicsClientId=client)
        start = [0.002, 0, 0.08]
        flags = pybullet.URDF_USE_INERTIA_FROM_FILE
        body = pybullet.loadURDF(str(assets["urdf"]), start, flags=flags, physicsClientId=client)
        mass, friction = pybullet.getDynamicsInfo(body, -1, physicsClientId=client)[:2]
        assert mass == pytest.approx(0.37)
        assert friction == pytest.approx(0.18)
        pybullet.setGravity(0, 0, -9.81, physicsClientId=client)
        for _ in range(480):
            pybullet.stepSimulation(physicsClientId=client)
        height = pybullet.getBasePositionAndOrientation(body, physicsClientId=client)[0][2]
        assert height == pytest.approx(HALF_M[2] + CENTER_M[2], abs=0.004)  # Bullet reports the centre of mass
    finally:
        pybullet.disconnect(client)


def test_drake_loads_it_and_it_rests_on_a_plane(assets):
    pytest.importorskip("pydrake", reason="extra `sim`")
    from pydrake.geometry import HalfSpace
    from pydrake.math import RigidTransform
    from pydrake.multibody.parsing import Parser
    from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, CoulombFriction
    from pydrake.systems.analysis import Simulator
    from pydrake.systems.framework import DiagramBuilder

    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlantSceneGraph(builder, 1e-3)
    Parser(plant).AddModels(str(assets["drake-sdf"]))
    half = HalfSpace.MakePose(np.array([0.0, 0, 1]), np.zeros(3))
    plant.RegisterCollisionGeometry(plant.world_body(), half, HalfSpace(), "ground", CoulombFriction(0.18, 0.18))
    plant.Finalize()
    body = plant.GetBodyByName("object")
    diagram = builder.Build()
    simulator = Simulator(diagram)
    context = plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    spatial = body.CalcSpatialInertiaInBodyFrame(context)
    assert spatial.get_mass() == pytest.approx(0.37)
    about_center = spatial.Shift(spatial.get_com()).CalcRotationalInertia().CopyToFullMatrix3()
    np.testing.assert_allclose(about_center, INERTIA, rtol=1e-6, atol=1e-12)
    plant.SetFreeBodyPose(context, body, RigidTransform([0, 0, 0.05]))
    simulator.AdvanceTo(0.6)
    assert plant.EvalBodyPoseInWorld(context, body).translation()[2] == pytest.approx(HALF_M[2], abs=0.003)
