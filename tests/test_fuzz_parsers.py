"""Damaged inputs of every parser end in a result or in one line; what once failed is in tests/corpus."""

import logging
import random

import pytest
from fuzzparsers import CORPUS, PARSERS, damaged, seeds, take


@pytest.mark.parametrize("times", [25, pytest.param(400, marks=[pytest.mark.slow, pytest.mark.timeout(900)])])
@pytest.mark.parametrize("parser", PARSERS)
def test_damaged_inputs_are_read_or_refused_in_one_line(parser, times, tmp_path, caplog):
    caplog.set_level(logging.CRITICAL)
    for path in sorted((CORPUS / parser).glob("*")):
        take(parser, path.read_bytes(), tmp_path)
    for good in seeds(parser):
        take(parser, good, tmp_path)
    rng = random.Random(times)
    for _ in range(times):
        take(parser, damaged(rng.choice(seeds(parser)), rng), tmp_path)
