"""The paper's figures as far as they are published; its breakdowns are not.

MVB-Grasp (Poudel, Basit, Shafique), 81 MuJoCo episodes of three objects in 27 poses; its times were taken on a GPU.
"""

RATES = {"vanilla": 0.247, "mvb": 0.593}
"""Success by method."""
EPISODES = 81
TIMES_MS = {"rank": 6.78, "filter": 2477.0, "together": 2947.0}
"""[ms] Fit, filter by the box and scores for 800 candidates; their collision check; from frame to plan, without
detection."""
