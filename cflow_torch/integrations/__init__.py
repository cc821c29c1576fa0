"""CorrelationFlow inside other code bases: OpenSceneFlow, BucketedSceneFlowEval, SceneFlowZoo."""
