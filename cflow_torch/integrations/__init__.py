"""The methods as models of other code bases: OpenSceneFlow, BucketedSceneFlowEval and SceneFlowZoo."""
