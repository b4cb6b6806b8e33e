"""Time by stage of a traced program, on a program and traces that are written by hand."""

import json

import jax
import jax.numpy as jnp
import pytest
from jax.profiler import ProfileData

from cref_jax.benchmarks import hlo, profiled, stage_times

# an update, and a loop of the physics with a product and a copy of XLA's own, which has no source
TEXT = """\
HloModule jit_chunk, is_scheduled=true

FileNames
1 "/there/cref_jax/ppo/learner.py"
2 "/there/cref_jax/physics/simulation.py"

FunctionNames
1 "update"
2 "Physics.step"

FileLocations
1 {file_name_id=1 function_name_id=1 line=8 end_line=8 column=1 end_column=2}
2 {file_name_id=2 function_name_id=2 line=9 end_line=9 column=1 end_column=2}

StackFrames
1 {file_location_id=1 parent_frame_id=1}
2 {file_location_id=2 parent_frame_id=1}


%body (c: f32[8,8]) -> f32[8,8] {
  %c = f32[8,8]{1,0} parameter(0)
  %product.1 = f32[8,8]{1,0} dot(%c, %c), metadata={stack_frame_id=2}
  ROOT %copy.9 = f32[8,8]{1,0} copy(%product.1)
}

ENTRY %main (x: f32[8,8]) -> f32[8,8] {
  %x = f32[8,8]{1,0} parameter(0)
  %sum.1 = f32[8,8]{1,0} add(%x, %x), metadata={stack_frame_id=1}
  %copy.8 = f32[8,8]{1,0} copy(%sum.1)
  ROOT %while.1 = f32[8,8]{1,0} while(%copy.8), condition=%c1, body=%body, metadata={stack_frame_id=2}
}
"""  # noqa: E501


def plane(name: str, **lines: list[tuple[str, str, float, float]]) -> str:
    """Write a plane; events by line: name, instruction or "", start and length, us."""
    text, metadata = "", 'stat_metadata { key: 1 value { id: 1 name: "hlo_op" } }'
    names = sorted({event[0] for events in lines.values() for event in events})
    for k, event in enumerate(names, 1):
        metadata += f' event_metadata {{ key: {k} value {{ id: {k} name: "{event}" }} }}'
    for line, events in lines.items():
        text += f' lines {{ name: "{line.replace("_", " #")}"'
        for event, instruction, start, length in events:
            op = f'stats {{ metadata_id: 1 str_value: "{instruction}" }}' if instruction else ""
            at = f"offset_ps: {round(1e6 * start)} duration_ps: {round(1e6 * length)}"
            text += f" events {{ metadata_id: {names.index(event) + 1} {at} {op} }}"
        text += " }"
    return f'planes {{ name: "{name}" {metadata} {text} }}'


def microseconds(*planes: str) -> dict[str, float]:
    trace = ProfileData.from_text_proto(" ".join(planes))
    stages = stage_times.time_stages(trace.planes, hlo.Program(TEXT))
    return {name: 1e6 * seconds for name, seconds in stages.items()}


def test_kernels_of_a_gpu_count_by_instruction_or_by_their_name_in_a_cuda_graph():
    gpu = plane(
        "/device:GPU:0",
        Stream_7=[
            ("gemm", "product.1", 0, 30),
            ("copy_9", "", 30, 4),  # the physics' loop has the copy that no source asked for
            ("solve_3f_cuda_kernel_forward", "", 40, 50),
            ("MemcpyD2D", "", 95, 1),
        ],
        Stream_8=[("sum_1", "sum.1", 10, 20)],
        Ops=[("sum.1", "sum.1", 10, 20)],  # the same once more, as a tool shows it
    )
    host = plane("/host:CPU", python=[("launch", "sum.1", 0, 900)])
    assert microseconds(host, gpu) == pytest.approx(
        {"physics: MuJoCo Warp": 50, "physics: rest": 34, "update": 20, "rest": 1}
    )


def test_on_a_cpu_an_instruction_counts_without_those_within_it_and_without_waiting():
    host = plane(
        "/host:CPU",
        XLA_1=[
            ("sum.1", "sum.1", 0, 10),
            ("while.1", "while.1", 10, 100),
            ("Execute", "", 12, 90),  # of the loop's 100 us 10 are its own
            ("product.1", "product.1", 20, 25),
            ("copy.9", "copy.9", 45, 5),
        ],
        XLA_2=[("product.1", "product.1", 20, 7)],
    )
    assert microseconds(host) == pytest.approx({"physics: rest": 10 + 25 + 5 + 7, "update": 10})


def test_a_record_sums_parts_to_stages_and_the_rest_of_the_time_is_idle():
    record = profiled.summarize({"physics: a": 0.03, "physics: b": 0.02, "update": 0.04}, 0.1)
    assert record["ms_per_iteration"] == 100.0
    assert record["stages"] == {
        "physics": {"ms": 50.0, "percent": 50.0},
        "update": {"ms": 40.0, "percent": 40.0},
        "idle": {"ms": 10.0, "percent": 10.0},
    }
    assert record["parts"]["physics: b"] == {"ms": 20.0, "percent": 20.0}


def test_where_threads_take_turns_the_parts_are_the_whole():
    record = profiled.summarize({"physics: a": 0.15, "update": 0.05}, 0.1)
    assert record["stages"]["physics"] == {"ms": 150.0, "percent": 75.0}
    assert record["stages"]["idle"]["ms"] == 0.0


def test_a_traced_call_returns_what_the_program_does_and_writes_its_stages(tmp_path):
    x = jnp.arange(4.0)
    program = jax.jit(lambda x: jnp.sin(x) @ x).lower(x).compile()
    result, line = profiled.trace_call(program, (x,), 1, 1, tmp_path)
    assert result == program(x)
    record = json.loads((tmp_path / "stages.json").read_text())
    assert set(record["stages"]) == {"rest", "idle"}  # no source of the project's
    assert line.startswith("traced: ") and (tmp_path / "trace.json.gz").exists()


def test_a_profiler_that_fails_leaves_the_result(tmp_path, monkeypatch):
    def fail(*_: object, **__: object) -> None:
        raise RuntimeError("no CUPTI")

    x = jnp.arange(4.0)
    program = jax.jit(jnp.sum).lower(x).compile()
    monkeypatch.setattr(jax.profiler, "start_trace", fail)
    result, line = profiled.trace_call(program, (x,), 1, 1, tmp_path)
    assert (result, line) == (6.0, "warning: no profile: RuntimeError: no CUPTI")
    assert list(tmp_path.iterdir()) == []
