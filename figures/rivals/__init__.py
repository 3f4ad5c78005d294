"""Ways of others that figures show: the paper's network and flow, Deng et al. 2022, distant light; flows in patches."""
