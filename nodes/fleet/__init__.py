"""Operations over many logs, on one machine or a Ray cluster, with results in a store."""
