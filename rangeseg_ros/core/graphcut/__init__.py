"""The energy E(f) = sum D_p(f_p) + sum w_pq [f_p != f_q] and the moves that lower it."""
