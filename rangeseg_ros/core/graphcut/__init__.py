"""The energy E(f) = sum D_p(f_p) + lambda sum u_pq [f_p != f_q] and the moves that lower it."""
