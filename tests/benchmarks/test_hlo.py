"""Counting a compiled program, on a text whose launches and bytes are worked out by hand."""

import pytest

from cref_jax.benchmarks import hlo

# a loop of five turns and one of an unknown number, a fusion with a product, one that reads a slice
TEXT = """\
HloModule jit_chunk, is_scheduled=true

FileNames
1 "/there/cref_jax/training/iteration.py"
2 "/there/cref_jax/physics.py"

FunctionNames
1 "chunk"
2 "Physics.step"

FileLocations
1 {file_name_id=1 function_name_id=1 line=8 end_line=8 column=1 end_column=2}
2 {file_name_id=2 function_name_id=2 line=9 end_line=9 column=1 end_column=2}

StackFrames
1 {file_location_id=1 parent_frame_id=1}
2 {file_location_id=2 parent_frame_id=2}


%product (p0: f32[8,4], p1: f32[4,2]) -> f32[8,2] {
  %p0 = f32[8,4]{1,0} parameter(0)
  %p1 = f32[4,2]{1,0} parameter(1)
  ROOT %dot.1 = f32[8,2]{1,0} dot(%p0, %p1), lhs_contracting_dims={1}, rhs_contracting_dims={0}
}

%row (p2: f32[100,8], p3: s32[]) -> (f32[1,8], f32[100,8]) {
  %p2 = f32[100,8]{1,0} parameter(0)
  %p3 = s32[] parameter(1)
  %zero = s32[] constant(0)
  %slice.1 = f32[1,8]{1,0} dynamic-slice(%p2, %p3, %zero), dynamic_slice_sizes={1,8}
  %put.1 = f32[100,8]{1,0} dynamic-update-slice(%p2, %slice.1, %p3, %zero)
  ROOT %both = (f32[1,8]{1,0}, f32[100,8]{1,0}) tuple(%slice.1, %put.1)
}

%known_body (c: (s32[], f32[8,4], f32[4,2])) -> (s32[], f32[8,4], f32[4,2]) {
  %c = (s32[], f32[8,4]{1,0}, f32[4,2]{1,0}) parameter(0)
  %a = f32[8,4]{1,0} get-tuple-element(%c), index=1
  %b = f32[4,2]{1,0} get-tuple-element(%c), index=2
  %product.1 = f32[8,2]{1,0} fusion(%a, %b), kind=kCustom, calls=%product, metadata={stack_frame_id=2}
  ROOT %copy.9 = f32[8,4]{1,0} copy(%a)
}

%open_body (d: f32[100,8]) -> f32[100,8] {
  %d = f32[100,8]{1,0} parameter(0)
  %one = s32[] constant(1)
  %row.1 = (f32[1,8]{1,0}, f32[100,8]{1,0}) fusion(%d, %one), kind=kLoop, calls=%row
  ROOT %e = f32[100,8]{1,0} get-tuple-element(%row.1), index=1
}

%rare (f: f32[16]) -> f32[16] {
  %f = f32[16]{0} parameter(0)
  ROOT %g = f32[16]{0} negate(%f)
}

%never (h: f32[16]) -> f32[16] {
  ROOT %h = f32[16]{0} parameter(0)
}

ENTRY %main (x: f32[100,8], y: f32[8,8], z: f32[16]) -> f32[16] {
  %x = f32[100,8]{1,0} parameter(0)
  %y = f32[8,8]{1,0} parameter(1)
  %z = f32[16]{0} parameter(2)
  %t = (s32[], f32[8,4]{1,0}, f32[4,2]{1,0}) tuple(%x, %y)
  %while.1 = (s32[], f32[8,4]{1,0}, /*index=2*/f32[4,2]{1,0}) while(%t), condition=%c1, body=%known_body, metadata={stack_frame_id=1}, backend_config={"known_trip_count":{"n":"5"}}
  %while.2 = f32[100,8]{1,0} while(%x), condition=%c2, body=%open_body, metadata={stack_frame_id=2}
  %chol.1 = f32[8,8]{1,0} custom-call(%y), custom_call_target="cusolver_potrf_ffi"
  ROOT %choice = f32[16]{0} conditional(%p, %z, %z), true_computation=%rare, false_computation=%never
}
"""  # noqa: E501
LEARN = hlo.Frame("/there/cref_jax/training/iteration.py", "chunk")
STEP = hlo.Frame("/there/cref_jax/physics.py", "Physics.step")


@pytest.fixture(scope="module")
def kernels():
    # of the loop in Physics.step three turns; in one case of four the branch is taken
    found = hlo.Program(TEXT).kernels(lambda stack: 3.0 if STEP in stack else 0.25)
    return dict(zip(["product", "copy", "row", "cholesky", "negate"], found, strict=True))


def test_a_loop_counts_as_often_as_it_turns(kernels):
    assert {name: kernel.times for name, kernel in kernels.items()} == {
        "product": 5.0,
        "copy": 5.0,
        "row": 3.0,
        "cholesky": 1.0,
        "negate": 0.25,
    }


def test_bytes_are_what_a_kernel_reads_and_writes(kernels):
    assert {name: kernel.bytes for name, kernel in kernels.items()} == {
        "product": 4 * (8 * 4 + 4 * 2 + 8 * 2),
        "copy": 4 * (8 * 4 + 8 * 4),
        "row": 4 * (8 + 1 + 8 + 8),  # of the 100 rows only the slice, its number, and two results
        "cholesky": 4 * (8 * 8 + 8 * 8),
        "negate": 4 * (16 + 16),
    }


def test_a_product_takes_two_operations_an_element_and_term(kernels):
    flops = {name: kernel.flops for name, kernel in kernels.items() if kernel.flops}
    assert flops == {"product": 2 * 8 * 2 * 4}


def test_a_kernel_knows_the_functions_it_comes_from(kernels):
    assert kernels["product"].stack == (STEP, LEARN) and kernels["product"].loop == (LEARN,)
    assert kernels["copy"].stack == () and kernels["copy"].loop == (LEARN,)
    assert kernels["row"].loop == (STEP, LEARN)
    assert kernels["cholesky"].operation == "cusolver_potrf_ffi"
