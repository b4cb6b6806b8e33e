"""Settings of the network, of PPO and of a run."""

from dataclasses import dataclass
from typing import Literal

Variant = Literal[
    "full", "no_cross_attention", "no_grf", "no_highway", "blind", "hpl_teacher", "hpl"
]
HPL = ("hpl_teacher", "hpl")  # teacher and student of Humanoid Parkour Learning


@dataclass(frozen=True)
class Network:
    """Widths of the actor (Sec. II-B) and of the critic. assumed: the paper gives none."""

    variant: Variant = "full"
    convolutions: tuple[tuple[int, int, int], ...] = ((32, 4, 4), (64, 3, 2))
    """Channels, kernel, stride of the depth tokenizer: 48 x 64 pixels to 6 x 8 tokens; on a CPU an
    update takes a third less time than with three 3 x 3 filters of stride 2"""
    token: int = 128  # d
    heads: int = 4  # of the cross attention
    compressed: int = 32  # C_psi(D)
    lstm: int = 256  # velocity estimator
    gru: int = 256  # recurrent fusion
    actor: tuple[int, ...] = (512, 256, 128)  # action head
    critic: tuple[int, ...] = (512, 256, 128)
    critic_sees: Literal["paper", "all"] = "all"
    """Eq. 3 alone, or also all that rewards depend on and that is drawn per robot; assumed"""
    initial_std: float = 0.8  # of the action distribution
    min_std: float = 0.0  # of it, while training: late obstacles are found by exploring, too

    @property
    def sees(self) -> bool:
        """Whether the actor has the depth camera's frames."""
        return self.variant not in ("blind", "hpl_teacher")


@dataclass(frozen=True)
class PPO:
    """Proximal policy optimisation. assumed: mjlab's numbers for a humanoid of this size."""

    horizon: int = 24  # control steps per iteration
    epochs: int = 5
    minibatches: int = 4
    clip: float = 0.2
    value_clip: float = 0.2
    value_weight: float = 1.0
    entropy_weight: float = 0.005
    estimator_weight: float = 1.0  # of the velocity estimator's L2 loss
    readout_weight: float = 0.0  # of predicting m_t from the actor's features; the paper: 0
    mirror_weight: float = 0.0  # of the symmetry loss; the paper: 0
    imitation_weight: float = 0.0  # of the distance to the teachers (nats); the paper: 0
    gamma: float = 0.99
    lam: float = 0.95
    learning_rate: float = 1e-3
    learning_rate_range: tuple[float, float] = (1e-5, 1e-2)
    critic_learning_rate: float = 0.0  # fixed, where the KL lowers the actor's; 0: the actor's
    target_kl: float = 0.01
    max_gradient_norm: float = 1.0
    average: int = 200  # iterations, at most, over which the kept policy is averaged; assumed
    critic_first: int = 0  # iterations in which the critic alone learns; for a run with --init


@dataclass(frozen=True)
class Distillation:
    """Who teaches, and how a student of variant hpl learns after its teacher's iterations."""

    teacher_iterations: int = 0  # in which PPO trains the teacher; 0: nine tenths of the run's
    learning_rate: float = 3e-4  # Humanoid Parkour Learning's code for quadrupeds
    teachers: tuple[str, ...] = ()
    """KIND=POLICY, or KIND:FIRST-LAST=POLICY for these levels: whom to imitate on lanes of this
    kind; on all others it is --init. undisturbed=POLICY, undisturbed/KIND=POLICY: for robots with
    nothing randomised. KIND=none: PPO alone"""
    true_senses: bool = False
    """Teachers sense without noise, errors of encoders and faults of depth, and so say what the
    student would do if it knew better"""


@dataclass(frozen=True)
class Run:
    """The size of a run, and how often it is saved."""

    num_envs: int = 4096  # environments, Sec. II-D
    iterations: int = 20_000  # Sec. II-D
    seed: int = 0
    chunk: int = 10  # iterations per call of the compiled program; changes no result
    checkpoint_minutes: float = 5.0  # between two checkpoints
    keep: int = 3  # checkpoints kept on disk
