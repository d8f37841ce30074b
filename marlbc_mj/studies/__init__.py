"""Studies: many independent episodes, measurements or trainings, and the report made from their results.

``protocol`` defines what a study is; ``runner`` runs any of them. The studies are ``bench`` (one episode per method, from
``episodes``), ``draws`` (many draws of a scenario), ``evaluate`` (held-out layouts), ``ablation``, ``calibration``,
``robot_gate``, ``perf`` (with ``perf_episode`` and ``perf_training``) and ``scale``, both of which use ``timing``, and
``learners``. ``robot_check`` checks a single robot.
"""
