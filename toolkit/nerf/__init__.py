"""Radiance fields: NeRF (Mildenhall et al. 2020) and DS-NeRF (Deng et al. 2022), to the paper or in minutes."""
