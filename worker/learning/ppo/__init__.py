"""The fused PPO: rollout, objective and update made for graphs and gangs."""
