"""Where each part of the paper lives: three lines an entry, read by ``paper_map``.

    id | done or left out | notebook | heading or cell id in it (- where there is none)
    function, as module.name | test, as file::name              (- where there is none)
    what the paper has there

Tests hold a ``done`` entry to its links; a ``left out`` one has no counterpart here.
"""

ENTRIES = """
Eq. 1 | done | 01_depth_loss_anatomy | 7 · The truth about every pixel (Fig. 4), and Eq. 1 and 2
loss_types.partition | test_loss_types.py::test_partition_is_complete_and_disjoint
X = X^op ∪ X^geo and D_in = D_in^op ∪ D_in^geo: image and depth fall into an optical and a geometric part

Eq. 2 | done | 01_depth_loss_anatomy | 7 · The truth about every pixel (Fig. 4), and Eq. 1 and 2
loss_types.Partition | test_loss_types.py::test_partition_is_complete_and_disjoint
the two parts are disjoint (printed as {φ}; ∅ is meant)

Eq. 3 | done | 06_full_pipeline | 11 · Put the windows back, and compose
pipeline.Ditr | test_pipeline.py::test_the_result_is_composed_of_what_both_branches_painted
D_out = DITR(D_in given X): the whole system

Eq. 4 | done | 07_metrics | 1 · Score three pixels by hand
metrics.rmse | test_metrics.py::test_three_pixels_by_hand
RMSE (printed over all HW pixels; counted where ground truth is known)

Eq. 5 | done | 07_metrics | 1 · Score three pixels by hand
metrics.mae | test_metrics.py::test_three_pixels_by_hand
MAE

Eq. 6 | done | 07_metrics | 1 · Score three pixels by hand
metrics.rel | test_metrics.py::test_three_pixels_by_hand
REL

Eq. 7 | done | 04_ddpm_math | Eq. 7 as printed, then as it must be
diffusion.q_sample | test_diffusion.py::test_eq7_holds_at_the_end_and_only_there
p(L_t given L_0) = N(0, I), which holds only in the limit

Eq. 8 | done | 04_ddpm_math | 5 · Train the prediction (Eq. 8) where the best answer is known
diffusion.loss | test_diffusion.py::test_eps_loss_is_eq8
the objective, E ‖ε − ε_θ(L_t, t, F(x))‖²

Eq. 9 | done | 04_ddpm_math | Eq. 9 as printed, then as it must be
diffusion.eps_from_x0 | test_diffusion.py::test_eq9_as_printed_is_not_unit_noise
ε_θ = L_t − α_t x_θ, which lacks a division

I1 | done | 04_ddpm_math | 3 · Take one step back: the posterior
diffusion.posterior_mean_variance | test_diffusion.py::test_posterior_is_bayes_rule
one step back, p_θ(D_{t−1} given D_t) = N(μ_θ, Σ_θ)

I2 | done | 07_metrics | Which δ did the tables use?
metrics.delta | test_metrics.py::test_delta_is_strict_and_symmetric
δ_{1+n%}, the share of pixels within n %

I3 | done | 03_vq_autoencoder | 1 · From one convolution to Enc and Dec
autoencoder.VQAutoencoder | test_autoencoder.py::test_shapes_and_latents_before_quantisation
L = Enc(D_in), D_out = Dec(L)

I4 | done | 05_boundary_maps | 2 · Read the formula: it is an intersection
boundary.depth_aware | boundary/test_maps.py::test_the_printed_formula_is_an_intersection
M_DA = M_RGB \\ ∁_U M_D, which is an intersection

S1 | done | 02_region_refinement | 3 · Decode, with a judge at every level
region.RegionNet | region/test_network.py::test_outputs_have_the_promised_shapes
stage one: encoder-decoder over colour and depth, feature fusion, boundary refinement

S2 | done | 02_region_refinement | 7 · Refine: a vote, then a reach
region.refine_region | region/test_network.py::test_refinement_agrees_with_the_naive_one
refinement: median 7 × 7, then dilation 5 × 5 in 3 iterations

S3 | done | 02_region_refinement | 6 · Train it as the paper says
training.as_the_paper.train_region | training/test_as_the_paper.py::test_constants_are_the_papers
training of stage one: SGD, batch 16, momentum 0.9, weight decay 1e-4, 200 epochs, a mixed learning rate

S4 | done | 02_region_refinement | 9 · Send the final error back through everything
training.finetune.finetune_region | training/test_finetune.py::test_the_region_moves_to_where_final_depth_gains
fine-tuning: stage two frozen, the final RMSE added to the loss, 1e-3, 50 epochs

S5 | done | 03_vq_autoencoder | 5 · Where the quantiser sits, and why diffusion cares
autoencoder.VQAutoencoder | test_autoencoder.py::test_shapes_and_latents_before_quantisation
autoencoder: no skip connections, scale 4 by two down- and two up-samplings, quantiser in the decoder

S6 | done | 10_training_at_scale | The paper's recipe is a configuration
training.as_the_paper.paper_recipe | training/test_as_the_paper.py::test_stage_two_has_the_papers_batch_and_rate
training of stage two: 1,000 diffusion steps, batch 64, learning rate 1e-6

S7 | done | 04_ddpm_math | Level by level
unet.DenoisingUNet | test_unet.py::test_paper_preset_can_be_counted_without_memory
U-Net: four levels, 3 × 3 convolutions and ReLU, max-pooling, doubling channels, self- and cross-attention

S8 | done | 05_boundary_maps | 5 · Three backends behind one call
stage_two.Plan | test_pipeline.py::test_each_branch_has_its_own_boundary_map
two extractors: M_DA guides the optical branch, M_RGB the geometric one

S9 | done | 06_full_pipeline | 11 · Put the windows back, and compose
pipeline.compose | test_composition.py::test_composition_follows_the_rule_pixel_by_pixel
mask × depth splits to two branches; inside re-estimated, outside filled, the rest kept or adjusted

T1 | done | 07_metrics | 7 · Audit the paper's tables
paper.audit.audit_table | paper/test_audit.py::test_the_impossible_rows_of_tables_1_and_2
results on ClearGrasp

T2 | done | 07_metrics | 7 · Audit the paper's tables
paper.audit.audit_table | paper/test_audit.py::test_the_impossible_rows_of_tables_1_and_2
results on TODD

T3 | done | 07_metrics | Which δ did the tables use?
paper.audit.below_rel_floor | paper/test_audit.py::test_the_worded_delta_is_refuted_by_three_rows_of_table_3
results on STD

T4 | done | 08_ablations | 2 · Climb the paper's ladder: BB, +DP, +RR
studies.swaps.Swapped | studies/test_swaps.py::test_regions_are_what_they_are_called
ablation: backbone, depth partition, region refinement

T5 | done | 08_ablations | Table V, ours beside the paper's
studies.swaps.beside_table_v | studies/test_swaps.py::test_the_breakdown_stands_beside_both_readings_of_table_v
error breakdown, geometric and optical; the order of its columns is audited in 07

T6 | done | 04_ddpm_math | Appendix · What the paper's sizes cost
evaluation.costs.beside_table_vi | evaluation/test_costs.py::test_table_vi_cannot_hold
latency and GFLOPs at 1280 × 720, per stage

A1 | done | 09_your_own_camera | 9 · Four cameras, one scene
simulator.cameras.measure | simulator/test_cameras.py::test_shipped_frames_show_the_signatures
generalisation without ground truth over four cameras

A2 | done | 08_ablations | 8 · Search for failures
studies.failures.correlations | studies/test_failures.py::test_correlations_are_taken_over_the_frames_in_both
failure cases: very large and overlapping objects

F1 | done | 01_depth_loss_anatomy | Fig. 1 of the paper, from our frames
loss_types.label | test_loss_types.py::test_label_names_each_kind_and_uses_both_thresholds
depth distortion of transparent and reflective objects

F2 | done | 01_depth_loss_anatomy | 5 · Why not from one picture: the ambiguity (Fig. 2)
camera.unproject | test_camera.py::test_a_scene_twice_as_large_and_as_far_gives_the_same_picture
ambiguity of depth from one colour image

F3 | done | 01_depth_loss_anatomy | 6 · Parallax: shadows that depth casts (Fig. 3)
camera.reproject | test_camera.py::test_shadow_has_the_predicted_width
geometric loss by parallax

F4 | done | 01_depth_loss_anatomy | 7 · The truth about every pixel (Fig. 4), and Eq. 1 and 2
loss_types.label | test_loss_types.py::test_label_names_each_kind_and_uses_both_thresholds
composition of depth loss

F5 | done | 06_full_pipeline | Follow one frame through the full pipeline
pipeline.Ditr | test_pipeline.py::test_stage_one_finds_the_region_and_refines_it
overview: two stages, two branches

F6 | done | 03_vq_autoencoder | 7 · Look at latents: the paper's figure, remade
autoencoder.VQAutoencoder | test_autoencoder.py::test_crops_and_whole_images_agree_in_the_interior
latent representation

F7 | done | 06_full_pipeline | 9 · Denoise
stage_two.paint | test_pipeline.py::test_the_result_is_composed_of_what_both_branches_painted
diffusion block: condition, encode, denoise, decode

F8 | done | 04_ddpm_math | Level by level
evaluation.costs.level_costs | evaluation/test_costs.py::test_levels_add_up_to_the_denoiser
denoising U-Net

F9 | done | 06_full_pipeline | Look at it
viz.grid | viz/test_grids.py::test_compare_draws_every_prediction_and_its_error
qualitative results beside other methods (ClearGrasp)

F10 | done | 09_your_own_camera | 10 · The public datasets, without a download
datasets.TODD | datasets/test_export.py::test_a_round_trip_keeps_all_that_the_format_holds
qualitative results (TODD); without a download, our frames in its layout

F11 | done | 09_your_own_camera | 10 · The public datasets, without a download
datasets.STD | datasets/test_export.py::test_a_round_trip_keeps_all_that_the_format_holds
qualitative results (STD); likewise

F12 | done | 09_your_own_camera | 10 · The public datasets, without a download
datasets.TROSD | datasets/test_datasets.py::test_every_reader
generalisation on TROSD; its layout read, and our scenes under four simulated cameras (section 9)

F13 | done | 08_ablations | The worst ten
studies.failures.worst | studies/test_failures.py::test_the_worst_come_first
failure cases

C1 | done | 08_ablations | 3 · Meet the peers, then ask where the error comes from
peers.gradient_solve.solve | peers/test_gradient_solve.py::test_depth_does_not_run_over_an_edge
DeepCompletion; the idea: predict orientation and edges, then solve for the depth that fits them and the readings

C2 | done | 08_ablations | 3 · Meet the peers, then ask where the error comes from
peers.ideas.RgbOnly | peers/test_ideas.py::test_colour_alone_is_shown_no_depth
DenseDepth; the idea: regress depth from colour alone

C3 | done | 08_ablations | 3 · Meet the peers, then ask where the error comes from
peers.ideas.SelfSupervised | peers/test_ideas.py::test_self_supervision_uses_no_truth_and_nothing_inside_the_region
SRD; the idea: depth from colour, taught and scaled by the readings outside the region

C4 | done | 08_ablations | 3 · Meet the peers, then ask where the error comes from
evaluation.protocols.fitted | peers/test_system.py::test_an_alignment_is_another_reading_of_the_same_weights
MiDaS; the idea: depth from colour up to scale and shift

C5 | done | 08_ablations | 3 · Meet the peers, then ask where the error comes from
peers.system.SingleSystem | peers/test_system.py::test_the_single_denoiser_is_told_of_no_region
LDM; the idea: one latent denoiser for all, no region

C6 | done | 08_ablations | 3 · Meet the peers, then ask where the error comes from
peers.ideas.NormalsOptimisation | peers/test_ideas.py::test_every_idea_paints_metres_and_learns
ClearGrasp; the idea: as DeepCompletion, after the readings inside the region are dropped

C7 | done | 08_ablations | 3 · Meet the peers, then ask where the error comes from
peers.ideas.ImplicitRays | peers/test_ideas.py::test_a_ray_begins_at_the_fill_and_ends_where_it_is_told
LIDF; the idea: an implicit function along each ray

C8 | done | 08_ablations | 3 · Meet the peers, then ask where the error comes from
peers.ideas.PointCompletion | peers/test_ideas.py::test_the_cloud_holds_readings_at_their_places
TranspareNet; the idea: complete the distorted cloud, then the map

C9 | done | 08_ablations | 3 · Meet the peers, then ask where the error comes from
peers.ideas.Regression | peers/test_ideas.py::test_untrained_a_painter_begins_at_the_fill
DFNet; the idea: correct the readings inside the region instead of dropping them

C10 | done | 08_ablations | 3 · Meet the peers, then ask where the error comes from
peers.ideas.Adversarial | peers/test_ideas.py::test_the_critic_is_held_while_it_judges_the_painter
DepthGrasp; the idea: let a critic tell completed depth from real

C11 | done | 08_ablations | 3 · Meet the peers, then ask where the error comes from
peers.ideas.blend | peers/test_ideas.py::test_confidence_decides_between_prediction_and_sensor
SwinDRNet; the idea: fuse colour and depth by confidence

N1 | done | 06_full_pipeline | Where we depart from the paper
windows.choose_windows | test_windows.py::test_every_pixel_of_a_region_is_painted_by_exactly_one_window_that_holds_it
the optical branch looks at a square around each piece of the region, not at the whole frame

N2 | done | 02_region_refinement | Where the paper differs
region.ColourEncoder | training/test_pretrained.py::test_folded_weights_compute_what_convolutions_and_batch_norms_did
colour goes through an encoder that was trained on real pictures, not on rendered ones

N3 | done | 06_full_pipeline | 10 · Decode both branches and sharpen
detail.DetailNet | test_detail.py::test_propagation_agrees_with_a_loop_over_pixels
a finer last step: depth spreads from the readings nearby by learnt affinities
"""
