"""The sizes of the networks."""

import re
import typing

from cref_jax import config, params
from cref_jax.config import Config, presets
from cref_jax.training.parameter_count import count_parameters


def test_the_count_of_each_variant_is_that_of_its_layers():
    names = typing.get_args(config.Variant)
    counts = count_parameters({name: presets.apply_file(Config(), name) for name in names})
    full, d = counts["full"], 128
    # norm 2 d, query, key, value and output d x d
    assert full["cross_attention"] == 2 * d + 4 * d * d
    # patches of 4 x 4 to 32, 3 x 3 x 32 to 64, 64 to d, places 48 x d, norm 2 d
    assert full["depth_tokenizer"] == (16 * 32 + 32) + (288 * 64 + 64) + (64 * d + d) + 50 * d
    # W_1 2d x 2d, W_2 2d x 4d, biases, norm of 2 x 2d; without the gate W_2 is 2d x 2d
    assert full["fusion"] == (2 * d) ** 2 + 2 * d + 8 * d * d + 4 * d + 4 * d
    assert full["fusion"] - counts["no_grf"]["fusion"] == 4 * d * d + 2 * d
    # W_beta is 4d x 2d
    lost = full["recurrent_fusion"] - counts["no_highway"]["recurrent_fusion"]
    assert lost == 8 * d * d + 2 * d
    assert {c["critic"] for c in counts.values()} == {full["critic"]}
    assert "depth_tokenizer" not in counts["blind"]
    # 21 x 11 heights to 128, 64 and 32; with 45 numbers of proprioception to 3 gates of 256
    teacher, gates = counts["hpl_teacher"], 3 * 256
    assert teacher["height_encoder"] == (231 * 128 + 128) + (128 * 64 + 64) + (64 * 32 + 32)
    # 48 x 64 by 5 x 5 to 44 x 60, pooled to 22 x 30; by 4 x 4 to 19 x 27, pooled to 9 x 13; by
    # 3 x 3 to 7 x 11
    filters = (25 * 16 + 16) + (16 * 16 * 32 + 32) + (9 * 32 * 32 + 32)
    latent = (7 * 11 * 32 * 128 + 128) + (128 * 32 + 32)
    assert counts["hpl"]["depth_encoder"] == filters + latent
    assert counts["hpl"]["gru"] == teacher["gru"]
    assert teacher["gru"] == (45 + 32) * gates + gates + 256 * gates + 256
    table = params.build_table(counts)
    assert [str(column.header) for column in table.columns] == ["part", *counts]


def test_no_number_is_cut_on_a_narrow_terminal(monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "20")
    params.main([])
    said = capsys.readouterr().out
    assert "no_cross_attention" in said and "…" not in said
    assert re.search(r"policy.* 1,\d{3},\d{3} ", said)
