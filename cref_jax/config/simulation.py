"""Settings of the simulated world: robot, physics, terrain, height scan, camera, footholds."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Robot:
    """The robot, and how the policy drives it (Sec. III-A)."""

    name: str | None = None  # an entry of robot/registry.py; None: its first
    actuated: Literal["legs", "legs+waist", "all"] = "legs"  # assumed: Table I regularises these
    held: Literal["none", "waist", "all"] = "all"
    """Joints outside the policy that stay movable under PD; all others are welded. assumed: with
    all welded, less is kept on the whole robot, see experiments/RESULTS.md"""
    action_scale: float = 0.25  # of effort / kp, rad; assumed: the usual scale for these gains
    action_clip: float = 10.0  # actions; assumed: far outside what is ever useful


@dataclass(frozen=True)
class Physics:
    """The simulation step, the same in every engine."""

    timestep: float = 0.005  # s; assumed: four substeps per control step are stable
    substeps: int = 4  # 4 x 5 ms = 20 ms = 50 Hz, Sec. II-D
    iterations: int = 6  # Newton; assumed: with 4, MJX and MuJoCo C differ by 0.03 rad/s per step
    line_search: int = 10  # assumed: as for the iterations
    velocity_limit: float = 100.0  # m/s or rad/s; assumed: beyond it a state has blown up

    @property
    def control_period(self) -> float:
        """Length of a control step, s."""
        return self.timestep * self.substeps


@dataclass(frozen=True)
class Terrain:
    """The lanes of training.

    Sizes of obstacles are in terrains/*.toml, the same for every robot: the legs of those here are
    of one length within 2 %. docs/your_robot.md says what another length asks for.
    """

    name: str = "flat"  # a file in terrains/, or a path to .toml, .npy or .png
    cell: float = 0.02  # m; assumed: divides treads, windows and strides
    lane_length: float = 12.0  # m; assumed
    lane_width: float = 4.0  # m; assumed
    levels: int = 10  # assumed: as legged_gym
    variants: int = 1  # lanes per level and kind, one drawn at each reset; assumed
    slits: float = 0.0  # m, the widest across half of the lanes, as between planks; 0: none
    slit_kinds: tuple[str, ...] = ()  # that may have slits or perforations; empty: all
    seed: int = 1  # of the random heights and landings


@dataclass(frozen=True)
class Scan:
    """The critic's height samples m_t, in the robot's yaw frame (Eq. 3), and a teacher's."""

    x: tuple[float, float, int] = (-0.5, 1.1, 17)  # m from, m to, samples; assumed
    y: tuple[float, float, int] = (-0.4, 0.4, 9)  # m from, m to, samples; assumed
    ahead: tuple[float, float, int] = (-0.2, 1.0, 25)
    """m from, m to, samples of a finer row along x in the middle. assumed: 10 cm cannot tell where
    an edge is"""
    teacher_x: tuple[float, float, int] = (-0.5, 1.5, 21)
    """m from, m to, samples that a teacher sees; Humanoid Parkour Learning (arXiv 2406.10759)"""
    teacher_y: tuple[float, float, int] = (-0.5, 0.5, 11)  # m from, m to, samples; as teacher_x
    base_height: float | None = None  # m, taken off: nominal, above the soles; None: the robot's
    clip: float = 1.0  # m; assumed


NARROW_VIEW = (62.0, 75.0)  # deg, vertical, horizontal, of a D435i at 640 x 480; its data sheet


@dataclass(frozen=True)
class Camera:
    """The depth camera, a RealSense D435i looking down at the ground ahead (Sec. III-A)."""

    shape: tuple[int, int] = (48, 64)  # rows, columns, Sec. II-D
    view: tuple[float, float] = (58.0, 87.0)
    """deg, vertical, horizontal; D435i data sheet, for streams of 16:9. assumed: one of these,
    squeezed, since those of 4:3 show less, 62 x 75"""
    d_max: float = 3.0  # m, Sec. II-B; assumed: published work clips at 2 to 3 m
    pitch: float | None = None  # deg below the horizontal, Sec. III-A; None: the robot's
    rate: float = 20.0  # 1/s, Sec. II-D
    window: int = 1
    """Pixels, odd: side of the square around each pixel whose nearest depth it reads, as a stereo
    camera matches squares and sees no hole smaller than one. 1, the paper's: one ray per pixel"""


@dataclass(frozen=True)
class Foothold:
    """The foothold placement reward (Sec. II-C), and the contact quality it is compared with."""

    points: tuple[int, int] = (60, 5)  # samples forward, across, Sec. II-C
    spacing: tuple[float, float] = (0.02, 0.025)  # m; assumed: window and stride are whole numbers
    window: tuple[int, int] = (12, 5)  # samples: 24 cm x 10 cm, Sec. II-C
    stride: int = 2  # samples: 4 cm, Sec. II-C
    gate_time: float = 0.5  # s of commanded travel, Sec. II-C
    gate: Literal["points", "windows"] = "points"
    """What is removed for being nearer than gate_time allows: points, so that windows are formed of
    those that remain (Sec. II-C), or each window with such a point"""
    min_points: int = 10  # of a window of remaining points; assumed: two rows of five
    roughness: float = 0.010  # m, r_th; assumed: refuses windows with an edge of 5 cm in them
    verticality: float = 0.9  # eta_th; assumed: slopes up to 0.4 pass, windows over a riser do not
    min_height: float = -0.5  # m, h_min; assumed: two 23 cm treads down pass, a gap's floor not
    quality_x: tuple[float, float, int] | None = None
    """m from, m to, samples of the sole; None: the robot's"""
    quality_y: tuple[float, float, int] | None = None
    """m from, m to, samples of the sole; None: the robot's"""
    quality_depth: float = -0.03
    """m under the sole, epsilon of the contact quality. assumed: BeamDojo's -0.1 is an absolute
    height, and stairs have no level to measure it from"""
