"""The field's benchmarks: layouts of labels, frozen profiles of the protocols, scores, reports."""
